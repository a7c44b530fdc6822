#!/usr/bin/env bash
# Builds the client for a headset and packs it with the OpenXR loader into a signed APK.
set -euo pipefail
HERE=$(dirname -- "$(readlink -f -- "$0")")
# Configuration changes of Android 12 and 14.
NEWER_CHANGES="fontWeightAdjustment grammaticalGender"

usage() {
  cat <<'EOT'
usage: android/package.sh LOADER [OUT.apk]

LOADER is Khronos's openxr_loader_for_android-*.aar, or the libopenxr_loader.so (arm64-v8a) from it.
OUT.apk defaults to out/shadecast.apk.

Needs cargo-ndk and the Android NDK; aapt, zipalign, apksigner and android.jar of the Android SDK.
environment:
  ANDROID_HOME          the SDK; its newest build-tools and platform are used
  ANDROID_JAR           android.jar, where there is no SDK folder
  LIBRARY               an already built libshadecast_android.so: nothing is compiled
  FEATURES              features of the library, such as openh264: a decoder on the CPU where the headset's own cannot be had
  KEYSTORE, KEY_ALIAS, KEYSTORE_PASS
                        sign a release with this key (KEYSTORE_PASS in apksigner's notation, such as file:PATH or env:NAME);
                        without them the APK is debuggable and signed with a debug key kept in ~/.android/

examples:
  android/package.sh openxr_loader_for_android-1.1.49.aar
  adb install -r out/shadecast.apk
EOT
}

die() {
  echo "package.sh: $*" >&2
  exit 1
}

find_tools() {
  local newest tool
  if [ -n "${ANDROID_HOME:-}" ]; then
    newest=$(find "$ANDROID_HOME/build-tools" -mindepth 1 -maxdepth 1 -type d 2>/dev/null | sort -V | tail -n 1)
    [ -z "$newest" ] || PATH="$newest:$PATH"
    newest=$(find "$ANDROID_HOME/platforms" -mindepth 2 -maxdepth 2 -name android.jar 2>/dev/null | sort -V | tail -n 1)
    ANDROID_JAR=${ANDROID_JAR:-$newest}
  fi
  for tool in aapt zipalign apksigner keytool unzip; do
    command -v "$tool" >/dev/null || die "'$tool' was not found; set ANDROID_HOME to an SDK with build-tools, and install a JRE and unzip"
  done
  [ -f "${ANDROID_JAR:-}" ] || die "no android.jar: install an SDK platform and set ANDROID_HOME, or set ANDROID_JAR"
}

build_library() {
  if [ -n "${LIBRARY:-}" ]; then
    cp -- "$LIBRARY" "$1/libshadecast_android.so"
    return
  fi
  cargo ndk --version >/dev/null 2>&1 || die "cargo-ndk was not found: cargo install cargo-ndk, rustup target add aarch64-linux-android"
  local target=$HERE/../target/android
  (cd -- "$HERE" && CARGO_TARGET_DIR=$target cargo ndk -t arm64-v8a -p 29 build --release --locked --features "${FEATURES:-}")
  cp -- "$target/aarch64-linux-android/release/libshadecast_android.so" "$1/"
}

take_loader() {
  case $1 in
    *.aar) unzip -p -- "$1" prefab/modules/openxr_loader/libs/android.arm64-v8a/libopenxr_loader.so >"$2/libopenxr_loader.so" ||
      die "$1 has no arm64-v8a loader: is it Khronos's openxr_loader_for_android?" ;;
    *.so) cp -- "$1" "$2/libopenxr_loader.so" ;;
    *) die "LOADER must be an .aar or a .so, not '$1'" ;;
  esac
}

# Uncompressed resources, as Android 11 and later want them.
compile() { # MANIFEST OUT.apk
  local mode=()
  [ -n "${KEYSTORE:-}" ] || mode=(--debug-mode)
  aapt package -f "${mode[@]}" -0 arsc -M "$1" -S "$HERE/res" -I "$ANDROID_JAR" -F "$2"
}

# The manifest with those of NEWER_CHANGES that the platform's resources know.
write_manifest() { # OUT.xml
  local change manifest
  manifest=$(<"$HERE/AndroidManifest.xml")
  for change in $NEWER_CHANGES; do
    # shellcheck disable=SC2001 # more than a replacement of text
    sed "s/\\(android:configChanges=\"[^\"]*\\)\"/\\1|$change\"/" <<<"$manifest" >"$1"
    if compile "$1" "$WORK/try.apk" >/dev/null 2>&1; then
      manifest=$(<"$1")
    else
      echo "package.sh: the platform's resources do not know the configuration change $change; on systems that have it, it ends the session" >&2
    fi
  done
  echo "$manifest" >"$1"
}

pack() {
  mkdir -p "$WORK/manifest"
  write_manifest "$WORK/manifest/AndroidManifest.xml"
  compile "$WORK/manifest/AndroidManifest.xml" "$WORK/base.apk"
  (cd -- "$WORK" && aapt add base.apk lib/arm64-v8a/*.so >/dev/null)
  zipalign -f -p 4 "$WORK/base.apk" "$WORK/aligned.apk"
}

sign() {
  local store=${KEYSTORE:-$HOME/.android/debug.keystore}
  if [ -z "${KEYSTORE:-}" ] && [ ! -e "$store" ]; then
    mkdir -p "$(dirname -- "$store")"
    keytool -genkeypair -keystore "$store" -storepass android -keypass android -alias androiddebugkey \
      -dname "CN=Android Debug,O=Android,C=US" -keyalg RSA -keysize 2048 -validity 10000
  fi
  apksigner sign --ks "$store" --ks-key-alias "${KEY_ALIAS:-androiddebugkey}" \
    --ks-pass "${KEYSTORE_PASS:-pass:android}" --min-sdk-version 29 --out "$1" "$WORK/aligned.apk"
  apksigner verify --min-sdk-version 29 "$1"
}

case ${1:-} in
  "" | -h | --help)
    usage
    exit 0
    ;;
esac
[ -r "$1" ] || die "cannot read the OpenXR loader '$1'; android/README.md says where it comes from"
OUT=${2:-$HERE/../out/shadecast.apk}
WORK=$(mktemp -d)
trap 'rm -rf -- "$WORK"' EXIT
LIBRARIES=$WORK/lib/arm64-v8a
mkdir -p "$LIBRARIES" "$(dirname -- "$OUT")"

find_tools
take_loader "$1" "$LIBRARIES"
build_library "$LIBRARIES"
pack
sign "$OUT"
echo "packed and signed: $OUT"
