#!/usr/bin/env bash
# Checks, on Linux, what runs on Windows: compiles and lints the whole workspace for it. With --link also links the programs and
# the mock runtime with mingw, the C++ library inside them.
set -euo pipefail
NAME=windows-check
TARGET=x86_64-pc-windows-gnu
# The flavour with POSIX threads: the other one has no std::mutex.
MINGW=x86_64-w64-mingw32
# shellcheck source=scripts/elsewhere.sh
. "$(dirname -- "$(readlink -f -- "$0")")/elsewhere.sh"

link() {
  STATIC=$(mktemp -d)
  trap 'rm -rf -- "$STATIC"' EXIT
  # The linker looks here first, and finds no import library of the C++ library: it takes the archive.
  ln -s -- "$($MINGW-g++-posix -print-file-name=libstdc++.a)" "$STATIC/"
  export CARGO_TARGET_X86_64_PC_WINDOWS_GNU_RUSTFLAGS="-Lnative=$STATIC"
  cargo build --target $TARGET --locked -p shadecast-server-cli -p shadecast-client -p shadecast-lab -p shadecast-mock-runtime
  local program programs="$CARGO_TARGET_DIR/$TARGET/debug"
  for program in shadecast-server.exe shadecast-client.exe shadecast-lab.exe shadecast_mock_runtime.dll; do
    [ -s "$programs/$program" ] || die "$programs/$program was not made"
    ! $MINGW-objdump -p "$programs/$program" | grep -i 'DLL Name: libstdc++' || die "$program asks for the C++ library"
  done
  echo "windows-check: programs in $programs"
}

needs_target
needs $MINGW-gcc-posix gcc-mingw-w64-x86-64-posix
needs $MINGW-g++-posix g++-mingw-w64-x86-64-posix
export CARGO_TARGET_X86_64_PC_WINDOWS_GNU_LINKER=$MINGW-gcc-posix
export CC_x86_64_pc_windows_gnu=$MINGW-gcc-posix CXX_x86_64_pc_windows_gnu=$MINGW-g++-posix
export AR_x86_64_pc_windows_gnu=$MINGW-gcc-ar-posix
# A folder of its own: this compiler may be another release than the host's.
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$ROOT/target/windows}"

# Not what is Android's alone.
cargo clippy --workspace --exclude shadecast-android --all-targets --target $TARGET --locked -- -D warnings
if [ "${1:-}" = --link ]; then link; fi
echo "windows-check: ok"
