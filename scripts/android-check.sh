#!/usr/bin/env bash
# Compiles and lints for a headset's system what runs there, without an NDK: nothing is linked, so missing symbols go unseen.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
TARGET=aarch64-linux-android
cd -- "$ROOT"

if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$TARGET/lib" ]; then
  echo "android-check: no standard library for $TARGET: rustup target add $TARGET" >&2
  exit 1
fi
if ! command -v clang >/dev/null; then
  echo "android-check: clang is needed for the C parts of ring: apt-get install clang" >&2
  exit 1
fi

# ring's C code asks for no header of the system when it is told so; an NDK given from outside is used instead.
export CC_aarch64_linux_android="${CC_aarch64_linux_android:-clang}"
export CFLAGS_aarch64_linux_android="${CFLAGS_aarch64_linux_android:--nostdlibinc -DRING_CORE_NOSTDLIBINC=1}"
# A folder of its own: this compiler may be another release than the host's.
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$ROOT/target/android}"

cargo clippy --target "$TARGET" --locked -p shadecast-protocol -p shadecast-transport -p shadecast-android -- -D warnings
