#!/usr/bin/env bash
# Checks, without an NDK, what runs on a headset: compiles and lints it for that system. With --link also links the library
# against stubs that define only the symbols of android/ndk-symbols.txt, with --pack as well packs it and lists what the APK holds.
# A check: what comes out runs nowhere.
set -euo pipefail
NAME=android-check
TARGET=aarch64-linux-android
API=29
# shellcheck source=scripts/elsewhere.sh
. "$(dirname -- "$(readlink -f -- "$0")")/elsewhere.sh"

# Stub libraries, empty but for their symbols. The NDK's libunwind is a static archive.
make_stubs() {
  local stubs=$1 library compile=(clang "--target=$TARGET$API" -fPIC -ffreestanding -nostdlibinc -fno-builtin -w)
  for library in c m dl log android mediandk nativewindow unwind; do
    {
      echo "int shadecast_stub_$library;"
      awk -v library=$library '$1 == library {print "void " $2 "(void) {}"}' android/ndk-symbols.txt
    } >"$stubs/$library.c"
    "${compile[@]}" -c "$stubs/$library.c" -o "$stubs/$library.o"
    [ $library = unwind ] || ld.lld -shared -soname lib$library.so -o "$stubs/lib$library.so" "$stubs/$library.o"
  done
  llvm-ar rcs "$stubs/libunwind.a" "$stubs/unwind.o"
}

link() {
  needs ld.lld lld
  needs llvm-ar llvm
  STUBS=$(mktemp -d)
  trap 'rm -rf -- "$STUBS"' EXIT
  make_stubs "$STUBS"
  local flags="-Lnative=$STUBS -Clink-arg=--target=$TARGET$API -Clink-arg=-fuse-ld=lld -Clink-arg=-nostartfiles"
  flags+=" -Clink-arg=-Wl,-z,defs -Clink-arg=-Wl,-error-limit=0"
  CARGO_TARGET_AARCH64_LINUX_ANDROID_LINKER=clang CARGO_TARGET_AARCH64_LINUX_ANDROID_RUSTFLAGS=$flags \
    cargo build --target $TARGET --locked -p shadecast-android
}

# Packs the library with a stub of the OpenXR loader, and holds what is in the APK against what is to be.
pack() {
  local jar=/usr/share/android-framework-res/framework-res.apk work library density expected icons=""
  [ -f "${ANDROID_JAR:-$jar}" ] || die "no resources of the platform: apt-get install android-framework-res, or set ANDROID_JAR"
  work=$(mktemp -d)
  library=$CARGO_TARGET_DIR/$TARGET/debug/libshadecast_android.so
  ld.lld -shared -soname libopenxr_loader.so -o "$work/libopenxr_loader.so" "$STUBS/c.o"
  # The debug key is the check's own.
  HOME=$work ANDROID_JAR=${ANDROID_JAR:-$jar} LIBRARY=$library android/package.sh "$work/libopenxr_loader.so" "$work/check.apk"
  unzip -l "$work/check.apk"
  # Densities are of Android's fourth version, which aapt says in their folders' names.
  for density in hdpi mdpi xhdpi xxhdpi xxxhdpi; do
    icons+=" res/mipmap-$density-v4/ic_launcher.png"
  done
  expected="AndroidManifest.xml lib/arm64-v8a/libopenxr_loader.so lib/arm64-v8a/libshadecast_android.so$icons resources.arsc"
  [ "$(unzip -Z1 "$work/check.apk" | grep -v '^META-INF/' | LC_ALL=C sort | xargs)" = "$expected" ] ||
    die "the APK holds something else than: $expected"
  aapt dump badging "$work/check.apk" | grep -q "^application: label='Shadecast' icon='res/mipmap-.*/ic_launcher.png'" ||
    die "the APK names no icon"
  rm -rf -- "$work"
}

needs_target
needs clang clang
# ring's C code asks for no header of the system when it is told so; a compiler given from outside is used instead.
export CC_aarch64_linux_android="${CC_aarch64_linux_android:-clang}"
export CFLAGS_aarch64_linux_android="${CFLAGS_aarch64_linux_android:--nostdlibinc -DRING_CORE_NOSTDLIBINC=1}"
# A folder of its own: this compiler may be another release than the host's.
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$ROOT/target/android}"

cargo clippy --target $TARGET --locked -p shadecast-model -p shadecast-protocol -p shadecast-transport -p shadecast-android -- -D warnings
for argument in "$@"; do
  case $argument in
    --link) link ;;
    --pack) pack ;;
    *) die "there is no option '$argument'" ;;
  esac
done
echo "android-check: ok"
