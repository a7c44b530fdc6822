#!/usr/bin/env bash
# The client that ships on Monado, a real OpenXR runtime: the head is moved from outside, both eyes are compared with the truth from
# where they are, the service is ended and comes back, and all ends are clean. The layer that checks calls of OpenXR watches.
#   monado-test.sh [--poses N] [--frames N] [--json FILE] [--make-box]
# Monado is the one that is installed, or lives in a box with a system of its own: scripts/monado-where.sh. 77 says that there is none.
set -euo pipefail
NAME=monado-test
# shellcheck source=scripts/elsewhere.sh
. "$(dirname -- "$(readlink -f -- "$0")")/elsewhere.sh"

skip() {
  echo "$NAME: SKIPPED: $*" >&2
  exit 77
}

poses=5 frames=300 json="" make_box=""
while [ $# -gt 0 ]; do
  case $1 in
    --poses) poses=$2 ;;
    --frames) frames=$2 ;;
    --json) json=$2 ;;
    --make-box)
      make_box=yes
      shift
      continue
      ;;
    *) die "'$1' is no option: --poses N, --frames N, --json FILE, --make-box" ;;
  esac
  shift 2
done

PROGRAMS=${PROGRAMS:-$ROOT/target/debug}
work=$(mktemp -d)
trap 'rm -rf -- "$work"' EXIT
needs python3 python3
# shellcheck source=scripts/monado-where.sh
. "$ROOT/scripts/monado-where.sh"
find_monado
# Where eyes look in Monado's picture: tangents of half its angles, and half the distance between them.
HALF_ANGLES_RAD="0.742 0.779"
HALF_PUPILS_M=0.0315
# Monado draws both eyes beside each other, each so large.
VIEW=480x540
# A picture with the wrong eye, or from the pose before, stays below; the right one is above.
LEAST_DB=24
pids=()

cleanup() {
  for pid in "${pids[@]}"; do kill "$pid" 2>/dev/null || true; done
  stop_service >/dev/null 2>&1 || true
  leave_monado
  rm -rf -- "$work"
}
trap cleanup EXIT

start_server() {
  rm -f "$work/server.txt" # what the one before said
  "$PROGRAMS/shadecast-server" stream "$work/scene.toml" --listen 127.0.0.1:0 --announce never --identity "$work/identity" \
    --atlas 2048x1024 --seconds 900 >"$work/server.txt" 2>&1 &
  server=$!
  pids+=("$server")
  wait_for "$work/server.txt" "Listening on" 60
  address=$(sed -n 's/^Listening on \([^ ]*\) .*/\1/p' "$work/server.txt")
}

LAYER=()
if has_layer; then
  LAYER=(XR_ENABLE_API_LAYERS=XR_APILAYER_LUNARG_core_validation XR_CORE_VALIDATION_EXPORT_TYPE=text
    XR_CORE_VALIDATION_FILE_NAME="$APP_THERE/core.txt")
else
  echo "$NAME: OpenXR's core validation layer is not there (package openxr-layer-corevalidation): calls are not checked" >&2
fi

start_client() {
  rm -f "$APP/core.txt" "$APP/stats.json" "$work/client.txt"
  "${MONADO[@]}" "${LAYER[@]}" "$APP_THERE/shadecast-client" --connect "$address" --stats "$APP_THERE/stats.json" >"$work/client.txt" 2>&1 &
  client=$!
  pids+=("$client")
}

wait_for() { # FILE TEXT SECONDS
  local left=$(($3 * 10))
  until grep -qF -- "$2" "$1" 2>/dev/null; do
    left=$((left - 1))
    [ $left -gt 0 ] || { tail -n 20 "$1" >&2; die "within $3 s nobody said '$2'"; }
    sleep 0.1
  done
}

ends_within() { # PID SECONDS
  local left=$(($2 * 10))
  while kill -0 "$1" 2>/dev/null; do
    left=$((left - 1))
    [ $left -gt 0 ] || die "a program did not end within $2 s"
    sleep 0.1
  done
  wait "$1"
}

# Decibels between what an eye sees and the truth from there: psnr EYE X Y Z YAW, eye -1 left, 1 right, and the half of Monado's
# picture that is looked at, 0 or 1.
psnr() { # EYE HALF X Y Z YAW
  local eye=$1 half=$2 place fov size
  place=$(awk -v e="$eye" -v h=$HALF_PUPILS_M -v x="$3" -v y="$4" -v z="$5" -v yaw="$6" 'BEGIN {
    a = yaw * 3.14159265 / 180; printf "%.5f,%.5f,%.5f", x + e * h * cos(a), y, z - e * h * sin(a) }')
  # shellcheck disable=SC2086 # two numbers
  set -- $HALF_ANGLES_RAD "$6"
  fov=$(awk -v v="$2" 'BEGIN { printf "%.3f", 2 * v * 180 / 3.14159265 }')
  # The truth's pixels are square, and Monado's are not.
  size=$(awk -v h="$1" -v v="$2" 'function tan(a) { return sin(a) / cos(a) } BEGIN { printf "%dx540", 540 * tan(h) / tan(v) + 0.5 }')
  local name="truth_${eye}_${place}_$3"
  if [ ! -s "$APP/$name.png" ]; then
    "$PROGRAMS/shadecast-server" forward "$work/scene.toml" --position "$place" --yaw "$3" --fov "$fov" --size "$size" \
      --out "$work/truth" >/dev/null 2>&1
    cp "$work/truth/forward-000000.png" "$APP/$name.png"
  fi
  "${THERE[@]}" convert "$APP_THERE/$name.png" -resize "$VIEW!" "$APP_THERE/truth.png"
  "${THERE[@]}" convert "$APP_THERE/shot.png" -crop "$VIEW+$((half * 480))+0" +repage "$APP_THERE/eye.png"
  # compare says by its exit code that pictures differ.
  "${THERE[@]}" compare -metric PSNR "$APP_THERE/eye.png" "$APP_THERE/truth.png" null: 2>&1 | awk '{ print $1 }' || true
}

# A new name for the file, since the head's holder reads it at any time and must not find half of it.
hold_head() { # "X Y Z YAW"
  echo "$1" >"$work/pose.new"
  mv "$work/pose.new" "$work/pose.txt"
}

# Waits until the head has been there for some frames, and compares both eyes.
look() { # NUMBER X Y Z YAW
  hold_head "$2 $3 $4 $5"
  sleep 12
  shot
  local left right
  left=$(psnr -1 0 "$2" "$3" "$4" "$5")
  right=$(psnr 1 1 "$2" "$3" "$4" "$5")
  echo "$NAME: pose $1 ($2 $3 $4, $5 degrees): left $left dB, right $right dB"
  results+=("$left" "$right")
  for db in "$left" "$right"; do
    awk -v db="$db" -v least=$LEAST_DB 'BEGIN { exit !(db >= least) }' || {
      cp "$APP/shot.png" monado-shot.png
      die "an eye shows something else than the truth ($db dB, at least $LEAST_DB): see monado-shot.png"
    }
  done
}

# Warnings and errors of the layer; it also says when it begins and ends.
core_messages() { if [ -s "$APP/core.txt" ]; then grep 'VALID_' "$APP/core.txt" | grep -cvE 'VALID_(DEBUG|INFO)' || true; else echo 0; fi; }

printf '%s\n' '[[model]]' 'name = "dragon"' 'file = "dragon"' \
  '[[instance]]' 'model = "dragon"' 'clip = ""' 'translation = [-0.7, 0, -3]' \
  '[[instance]]' 'model = "dragon"' 'clip = ""' 'translation = [0.9, 0, -3.6]' >"$work/scene.toml"
"$PROGRAMS/shadecast-server" inspect "$work/scene.toml" >/dev/null || die "the scene of the test cannot be read"

results=()
hold_head "0 1.6 0 0"
python3 scripts/monado_head.py "$work/pose.txt" &
pids+=($!)

start_service || skip "Monado's service does not start here"
cp "$PROGRAMS/shadecast-client" "$PROGRAMS/examples/wrong_call" "$PROGRAMS/libshadecast_mock_runtime.so" "$APP/"

# The layer must see what is wrong, or its silence means nothing.
control=0
if [ ${#LAYER[@]} -gt 0 ]; then
  rm -f "$APP/core.txt"
  "${MONADO[@]}" "${LAYER[@]}" "$APP_THERE/wrong_call" >/dev/null 2>&1 || true
  control=$(core_messages)
  [ "$control" -gt 0 ] || die "the layer that checks calls says nothing of a wrong one"
fi

start_server

# The same layer over the project's own runtime, with a controller in use.
echo "{ \"file_format_version\": \"1.0.0\", \"runtime\": { \"name\": \"mock\", \"library_path\": \"$APP_THERE/libshadecast_mock_runtime.so\" } }" >"$APP/mock.json"
echo '{ "extent_pixels": [64, 64], "controllers": "/interaction_profiles/oculus/touch_controller" }' >"$APP/mock-config.json"
rm -f "$APP/core.txt"
"${MONADO[@]}" XR_RUNTIME_JSON="$APP_THERE/mock.json" SHADECAST_MOCK_CONFIG="$APP_THERE/mock-config.json" "${LAYER[@]}" \
  "$APP_THERE/shadecast-client" --connect "$address" >"$work/mock.txt" 2>&1 &
client=$!
pids+=("$client")
# It compiles its pipelines before it connects: 10 s where nothing is cached and others compute.
wait_for "$work/mock.txt" "Connected to" 60
sleep 5
kill -INT "$client"
ends_within "$client" 30 || die "the client fails on the mock: $(tail -n 3 "$work/mock.txt")"
[ ${#LAYER[@]} = 0 ] || [ -s "$APP/core.txt" ] || die "on the mock the layer did not run"
on_mock=$(core_messages)
[ "$on_mock" = 0 ] || { cat "$APP/core.txt" >&2; die "the layer that checks calls has $on_mock messages over the mock"; }

start_client
wait_for "$work/client.txt" "Connected to" 60
list=("0 1.6 0 0" "0.4 1.6 0.2 15" "-0.5 1.3 -0.3 -12" "0.2 1.9 0.4 -25" "0 1.6 -0.6 8")
for ((number = 1; number <= poses; number++)); do
  # shellcheck disable=SC2086 # four numbers
  look "$number" ${list[$(((number - 1) % ${#list[@]}))]}
done
# The same picture beside the other eye's truth, and beside that of the pose before.
# shellcheck disable=SC2206 # four numbers
last=(${list[$(((poses - 1) % ${#list[@]}))]}) before=(${list[$(((poses + 3) % ${#list[@]}))]})
swapped=$(psnr 1 0 "${last[@]}")
stale=$(psnr -1 0 "${before[@]}")
echo "$NAME: for comparison, with the other eye's truth $swapped dB, with that of the pose before $stale dB"

# The headset goes, and comes back.
stop_service
wait_for "$work/client.txt" "the headset is gone" 30
start_service
sleep 20
look again 0.3 1.5 0 -10

# The client first: cleanly, and it says so to the server.
kill -INT "$client"
ends_within "$client" 30 || die "the client did not end cleanly: $(tail -n 3 "$work/client.txt")"
cp "$APP/stats.json" "$work/stats.json"
shown=$(sed -n 's/.*"rendered_frames": *\([0-9]*\).*/\1/p' "$APP/stats.json")
wait_for "$work/server.txt" "the user left" 10
messages=$(core_messages)

# The server first: the world stands still, and the client stays until it is asked to leave.
start_client
wait_for "$work/client.txt" "Connected to" 60
kill -INT "$server"
ends_within "$server" 30 || die "the server did not end cleanly"
sleep 3
kill -0 "$client" || die "the client ended with its server"
kill -INT "$client"
ends_within "$client" 30 || die "the client did not end cleanly after its server"

# The service first.
start_server
start_client
wait_for "$work/client.txt" "Connected to" 60
stop_service
wait_for "$work/client.txt" "the headset is gone" 30
kill -INT "$client"
ends_within "$client" 40 || die "the client did not end cleanly after its runtime"
kill -INT "$server"
ends_within "$server" 30 || die "the server did not end cleanly"

repeated=$(sed -n 's/.*"repeated_frames": *\([0-9]*\).*/\1/p' "$work/stats.json")
echo "$NAME: $shown pictures and $repeated repetitions, $messages messages of the layer, $on_mock over the mock ($control where a call is wrong)"
[ "$messages" = 0 ] || { cat "$APP/core.txt" >&2; die "the layer that checks calls has $messages messages"; }
[ "$shown" -ge "$frames" ] || die "$shown pictures, of which $frames were asked for"
if [ -n "$json" ]; then
  printf '{\n  "frames": %s,\n  "repeated_frames": %s,\n  "psnr_db": [%s],\n  "other_eye_db": %s,\n  "stale_db": %s,\n  "least_db": %s,\n  "layer_messages": %s,\n  "layer_messages_on_mock": %s,\n  "layer_messages_of_a_wrong_call": %s\n}\n' \
    "$shown" "$repeated" "$(IFS=,; echo "${results[*]}")" "$swapped" "$stale" "$(printf '%s\n' "${results[@]}" | sort -g | head -n 1)" "$messages" "$on_mock" "$control" >"$json"
fi
echo "$NAME: ok"
