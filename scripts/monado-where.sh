# shellcheck shell=bash disable=SC2034
# Where Monado is, and how it is started, stopped and looked at there: the one that is installed on this machine, or one in a box with a
# newer system, which the scripts in MONADO_TOOLS make and run. Sourced by monado-test.sh.
#
# APP is a folder that programs there see as APP_THERE. What begins with THERE runs there, and what begins with MONADO on the runtime:
# "${MONADO[@]}" [VARIABLE=VALUE..] PROGRAM [ARGUMENT..]
# (shellcheck does not see that who sources this uses them.)

TOOLS=${MONADO_TOOLS:-../shared/tools/monado}
export BOX=${BOX:-/opt/monado-box}
# The display of the installed one's compositor.
MONADO_DISPLAY=${MONADO_DISPLAY:-:97}
where=""

find_monado() {
  if command -v monado-service >/dev/null; then
    where=here
  else
    # shellcheck disable=SC2154 # the caller's option
    if [ -n "$make_box" ] && [ -x "$TOOLS/box.sh" ] && [ ! -e "$BOX/.ready" ] && [ "$(id -u)" = 0 ]; then
      needs debootstrap debootstrap
      echo "$NAME: making a box for Monado in $BOX (a gigabyte, some minutes)"
      # shellcheck disable=SC2154 # the caller's folder
      "$TOOLS/box.sh" >"$work/box.txt" 2>&1 || { tail -n 5 "$work/box.txt" >&2; skip "the box could not be made"; }
    fi
    [ -x "$TOOLS/service.sh" ] || skip "monado-service is not installed (package monado-service), and there are no scripts that run it in a box; name their folder with MONADO_TOOLS"
    [ -e "$BOX/.ready" ] || skip "monado-service is not installed, and there is no box with it: --make-box makes one (a gigabyte, some minutes, as root)"
    [ "$(id -u)" = 0 ] || skip "the box is entered by root alone"
    where=box
  fi
  enter_"$where"
}

enter_box() {
  APP=$BOX/app APP_THERE=/app
  THERE=(chroot "$BOX")
  MONADO=(chroot "$BOX" env XDG_RUNTIME_DIR=/run/xr HOME=/root XR_RUNTIME_JSON=/usr/share/openxr/1/openxr_monado.json)
  "$TOOLS/box.sh" mount
}

enter_here() {
  needs Xvfb xvfb
  needs import imagemagick
  APP=$work/app APP_THERE=$work/app
  mkdir -m 700 "$APP" "$work/run"
  local file
  for file in ${MONADO_JSON:+"$MONADO_JSON"} /usr/share/openxr/1/openxr_monado.json /usr/local/share/openxr/1/openxr_monado.json; do
    [ -e "$file" ] || continue
    THERE=()
    MONADO=(env XDG_RUNTIME_DIR="$work/run" XR_RUNTIME_JSON="$file")
    return
  done
  skip "Monado's openxr_monado.json was not found (package libopenxr1-monado); name it with MONADO_JSON"
}

leave_monado() { [ "$where" != box ] || "$TOOLS/box.sh" umount || true; }

has_layer() {
  local root=""
  [ "$where" != box ] || root=$BOX
  local folder
  for folder in /usr/share /usr/local/share /etc; do
    if ls "$root$folder"/openxr/1/api_layers/explicit.d/*core_validation*.json >/dev/null 2>&1; then return 0; fi
  done
  return 1
}

# A headset that is moved from outside, a compositor with a window of half its size.
start_service() {
  if [ "$where" = box ]; then
    SCALE=50 "$TOOLS/service.sh" start main remote >/dev/null
    return
  fi
  Xvfb "$MONADO_DISPLAY" -screen 0 1280x720x24 -nolisten tcp >"$work/xvfb.txt" 2>&1 &
  xvfb=$!
  sleep 1
  # With its standard input closed it ends, unless it is told not to read it.
  env XDG_RUNTIME_DIR="$work/run" XRT_NO_STDIN=1 P_OVERRIDE_ACTIVE_CONFIG=remote DISPLAY="$MONADO_DISPLAY" \
    XRT_COMPOSITOR_FORCE_XCB=1 XRT_COMPOSITOR_SCALE_PERCENTAGE=50 monado-service >"$work/service.txt" 2>&1 &
  service=$!
  local left=300
  until grep -qF "service has started" "$work/service.txt"; do
    left=$((left - 1))
    [ $left -gt 0 ] || { tail -n 5 "$work/service.txt" >&2; return 1; }
    sleep 0.1
  done
}

stop_service() {
  if [ "$where" = box ]; then
    "$TOOLS/service.sh" stop
    return
  fi
  local pid
  for pid in ${service:-} ${xvfb:-}; do
    kill "$pid" 2>/dev/null || true
    wait "$pid" 2>/dev/null || true
  done
  service="" xvfb=""
  rm -rf "$work/run"
  mkdir -m 700 "$work/run"
}

# What both eyes see, beside each other, to APP/shot.png.
shot() {
  if [ "$where" = box ]; then
    "$TOOLS/service.sh" shot "$work/shot.png"
  else
    DISPLAY=$MONADO_DISPLAY import -window root "$APP/shot.png"
  fi
}
