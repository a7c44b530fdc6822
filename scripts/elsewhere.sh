# shellcheck shell=bash
# What the checks for other systems begin with: into the project's folder, and words for what is missing. Sourced by them, with
# NAME, what they call themselves, and TARGET, what they compile for.
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "${BASH_SOURCE[0]}")")")
cd -- "$ROOT" || exit

die() {
  echo "$NAME: $*" >&2
  exit 1
}

needs() { # TOOL PACKAGE
  command -v "$1" >/dev/null || die "'$1' was not found: apt-get install $2"
}

needs_target() {
  [ -d "$(rustc --print sysroot)/lib/rustlib/$TARGET/lib" ] || die "no standard library for $TARGET: rustup target add $TARGET"
}
