#!/usr/bin/env bash
# Runs, on an emulated 64-bit ARM processor, the tests of what headsets compute by themselves: the bytes of deltas and motion, and
# the CPU twins of what moves vertices. Release: debug code would take the emulator minutes.
set -euo pipefail
NAME=arm64-test
TARGET=aarch64-unknown-linux-gnu
LIBRARIES=/usr/aarch64-linux-gnu
# shellcheck source=scripts/elsewhere.sh
. "$(dirname -- "$(readlink -f -- "$0")")/elsewhere.sh"

needs_target
needs aarch64-linux-gnu-gcc gcc-aarch64-linux-gnu
needs qemu-aarch64 qemu-user
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L $LIBRARIES"
export CC_aarch64_unknown_linux_gnu=aarch64-linux-gnu-gcc
# A folder of its own, as for the other systems.
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$ROOT/target/arm64}"

cargo test --release --locked --target $TARGET -p shadecast-model -p shadecast-protocol -p shadecast-shaders "$@"
echo "arm64-test: ok"
