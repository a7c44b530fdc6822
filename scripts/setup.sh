# shellcheck shell=bash
# What a fresh machine lacks, found and installed. Sourced by ../shadecast, which sets ROOT.
# Finding out costs a few milliseconds and no rights, so every command begins with it.

# The C++ compiler and nasm are for openh264 (without nasm it silently builds without its assembly) and the metrics; glslang
# compiles the shaders; procps has `kill`, with which the demo and the process tests end what they started. The X libraries
# are loaded by the forward renderer's window when it opens; xvfb is a display for its test.
PACKAGES=(g++ nasm glslang-tools libvulkan1 mesa-vulkan-drivers vulkan-validationlayers
  libopenxr-loader1 ca-certificates procps
  libx11-6 libx11-xcb1 libxcb1 libxcursor1 libxi6 libxkbcommon-x11-0 libxrandr2 xvfb)

# Debian 12's own Mesa 22.3 draws only the first view of a multiview pass on the CPU device; its backports have 25.
MESA_MAJOR_MIN=25
BACKPORTS_FILE=shadecast-backports.sources

APT_DIR=${APT_DIR:-/etc/apt}
OS_RELEASE=${OS_RELEASE:-/etc/os-release}

die() {
  printf 'shadecast: %s\n' "$@" >&2
  exit 1
}

os_field() { [ -r "$OS_RELEASE" ] && sed -n "s/^$1=//p" "$OS_RELEASE" | tr -d '"'; }

wants_backports() { [ "$(os_field VERSION_CODENAME)" = bookworm ] && [ "$(os_field ID)" != ubuntu ]; }

installed_version() {
  # shellcheck disable=SC2016 # dpkg-query's own placeholders
  dpkg-query -W -f '${db:Status-Status} ${Version}\n' "$1" 2>/dev/null | sed -n 's/^installed //p' | head -n 1
}

is_installed() {
  local version
  version=$(installed_version "$1")
  [ -n "$version" ] || return 1
  if [ "$1" = mesa-vulkan-drivers ] && wants_backports; then
    dpkg --compare-versions "$version" ge "$MESA_MAJOR_MIN"
  fi
}

missing_packages() {
  local package
  for package in "${PACKAGES[@]}"; do is_installed "$package" || echo "$package"; done
}

# One line for each enabled binary source: suite, URIs, Signed-By, Trusted, separated by tabs; a line break inside an embedded
# key becomes '|'. Reads both formats, sources.list lines and deb822 stanzas.
apt_sources() {
  local file
  for file in "$APT_DIR"/sources.list "$APT_DIR"/sources.list.d/*.list; do
    if [ -r "$file" ]; then one_line_sources "$file"; fi
  done
  for file in "$APT_DIR"/sources.list.d/*.sources; do
    if [ -r "$file" ]; then deb822_sources "$file"; fi
  done
}

one_line_sources() {
  awk '
    { sub(/#.*/, "") }
    $1 != "deb" { next }
    {
      signed = trusted = ""
      if (match($0, /\[[^]]*\]/)) {
        n = split(substr($0, RSTART + 1, RLENGTH - 2), options, /[ \t]+/)
        for (i = 1; i <= n; i++) {
          if (options[i] ~ /^signed-by=/) signed = substr(options[i], 11)
          if (options[i] ~ /^trusted=/) trusted = substr(options[i], 9)
        }
        $0 = substr($0, 1, RSTART - 1) substr($0, RSTART + RLENGTH)
      }
      if ($2 !~ /^cdrom:/) printf "%s\t%s\t%s\t%s\n", $3, $2, signed, trusted
    }' "$1"
}

deb822_sources() {
  awk '
    function flush(   n, i, suites) {
      if (fields["types"] ~ /(^| )deb( |$)/ && tolower(fields["enabled"]) !~ /^(no|false|0|off)$/) {
        n = split(fields["suites"], suites, /[ |\t]+/)
        for (i = 1; i <= n; i++) if (suites[i] != "")
          printf "%s\t%s\t%s\t%s\n", suites[i], fields["uris"], fields["signed-by"], fields["trusted"]
      }
      delete fields
      name = ""
    }
    /^#/ { next }
    /^[ \t]*$/ { flush(); next }
    /^[ \t]/ { line = $0; sub(/[ \t]+$/, "", line); fields[name] = fields[name] "|" line; next }
    {
      colon = index($0, ":")
      name = tolower(substr($0, 1, colon - 1))
      value = substr($0, colon + 1)
      gsub(/^[ \t]+|[ \t]+$/, "", value)
      fields[name] = value
    }
    END { flush() }' "$1"
}

# The stanza that adds SUITE-backports from the machine's own mirror; nothing if SUITE itself has no source.
backports_stanza() {
  apt_sources | awk -F '\t' -v suite="$1" '
    $1 == suite {
      gsub(/\|/, "\n", $2); gsub(/\|/, "\n", $3)
      print "Types: deb\nURIs: " $2 "\nSuites: " suite "-backports\nComponents: main"
      if ($3 != "") print "Signed-By:" ($3 ~ /^\n/ ? "" : " ") $3
      if ($4 != "") print "Trusted: " $4
      exit
    }'
}

has_suite() { apt_sources | cut -f 1 | grep -qxF "$1"; }

# Sets SUDO to the words that make a command run as root, or fails.
find_root() {
  SUDO=()
  [ "$(id -u)" -ne 0 ] || return 0
  SUDO=(sudo -n)
  command -v sudo >/dev/null && sudo -n true 2>/dev/null
}

print_commands() {
  local stanza=$1 mesa_suite=$2
  shift 2
  echo "shadecast: packages are missing and this user may not install them. As root, run:"
  echo
  if [ -n "$stanza" ]; then
    printf "  cat > %s/sources.list.d/%s <<'END'\n%s\nEND\n" "$APT_DIR" "$BACKPORTS_FILE" "$stanza"
  fi
  echo "  apt-get update"
  [ $# -eq 0 ] || echo "  apt-get install --no-install-recommends $*"
  [ -z "$mesa_suite" ] || echo "  apt-get install --no-install-recommends -t $mesa_suite mesa-vulkan-drivers"
  echo
  echo "and then this command again."
}

apt_get() {
  # A fresh machine often updates itself in the background: wait for its lock instead of failing.
  "${SUDO[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=600 "$@" </dev/null
}

install_packages() {
  local stanza=$1 mesa_suite=$2
  shift 2
  if [ -n "$stanza" ]; then
    echo "setup: adding $mesa_suite from this machine's own mirror"
    printf '%s\n' "$stanza" | "${SUDO[@]}" tee "$APT_DIR/sources.list.d/$BACKPORTS_FILE" >/dev/null
  fi
  apt_get update || die "'apt-get update' failed (its message is above): is the network there, are the sources right?"
  if [ $# -gt 0 ]; then
    apt_get install -y --no-install-recommends "$@" ||
      die "could not install: $* (apt's message is above; on Ubuntu the component 'universe' must be enabled)"
  fi
  if [ -n "$mesa_suite" ]; then
    apt_get install -y --no-install-recommends -t "$mesa_suite" mesa-vulkan-drivers ||
      die "could not install mesa-vulkan-drivers from $mesa_suite (apt's message is above)"
  fi
}

setup_with_apt() {
  local missing=() plain=() stanza="" mesa_suite="" package
  mapfile -t missing < <(missing_packages)
  [ ${#missing[@]} -gt 0 ] || return 0
  for package in "${missing[@]}"; do
    if [ "$package" = mesa-vulkan-drivers ] && wants_backports; then
      mesa_suite=bookworm-backports
    else
      plain+=("$package")
    fi
  done
  if [ -n "$mesa_suite" ] && ! has_suite "$mesa_suite"; then
    stanza=$(backports_stanza bookworm)
    [ -n "$stanza" ] || die "no apt source for 'bookworm' in $APT_DIR: cannot tell which mirror has bookworm-backports" \
      "Add a source for bookworm-backports, then run this command again."
  fi
  if ! find_root; then
    print_commands "$stanza" "$mesa_suite" "${plain[@]}" >&2
    exit 1
  fi
  echo "setup: installing ${missing[*]}"
  install_packages "$stanza" "$mesa_suite" "${plain[@]}"
  mapfile -t missing < <(missing_packages)
  [ ${#missing[@]} -eq 0 ] || die "still missing or too old after the installation: ${missing[*]}" \
    "'apt-cache policy ${missing[*]}' shows what the sources offer."
}

has_library() { { ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -qF "$1"; }

setup_without_apt() {
  local missing=() tool library
  for tool in c++ nasm glslangValidator; do command -v "$tool" >/dev/null || missing+=("$tool"); done
  for library in libvulkan.so.1 libopenxr_loader.so.1; do has_library "$library" || missing+=("$library"); done
  [ ${#missing[@]} -eq 0 ] || die "this system has no apt; please install with its own package manager: ${missing[*]}" \
    "Also needed: a Vulkan driver (Mesa $MESA_MAJOR_MIN or newer if it is lavapipe) and the Vulkan validation layers."
}

check_rust() {
  local wanted found
  wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' "$ROOT/Cargo.toml")
  if ! { command -v cargo && command -v rustc; } >/dev/null; then
    die "cargo and rustc were not found. Install Rust $wanted or newer: https://rustup.rs"
  fi
  found=$(cd -- "$ROOT" && rustc --version | sed 's/^rustc \([0-9.]*\).*/\1/') ||
    die "'rustc --version' failed in $ROOT (its message is above)"
  printf '%s\n' "$wanted" "$found" | sort -V -C ||
    die "Rust $found is too old: $wanted or newer is needed. With rustup: rustup update stable"
}

setup_all() {
  check_rust
  if command -v apt-get >/dev/null && command -v dpkg-query >/dev/null; then
    setup_with_apt
  else
    setup_without_apt
  fi
}
