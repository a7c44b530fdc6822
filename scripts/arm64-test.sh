#!/usr/bin/env bash
# Runs, on an emulated 64-bit ARM processor, the tests of what headsets compute by themselves: the bytes of deltas and motion, and
# the CPU twins of what moves vertices. Release: debug code would take the emulator minutes.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
TARGET=aarch64-unknown-linux-gnu
LIBRARIES=/usr/aarch64-linux-gnu
cd -- "$ROOT"

die() {
  echo "arm64-test: $*" >&2
  exit 1
}

needs() { # TOOL PACKAGE
  command -v "$1" >/dev/null || die "'$1' was not found: apt-get install $2"
}

[ -d "$(rustc --print sysroot)/lib/rustlib/$TARGET/lib" ] || die "no standard library for $TARGET: rustup target add $TARGET"
needs aarch64-linux-gnu-gcc gcc-aarch64-linux-gnu
needs qemu-aarch64 qemu-user
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L $LIBRARIES"
export CC_aarch64_unknown_linux_gnu=aarch64-linux-gnu-gcc
# A folder of its own, as for the other systems.
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$ROOT/target/arm64}"

cargo test --release --locked --target $TARGET -p shadecast-protocol -p shadecast-shaders "$@"
echo "arm64-test: ok"
