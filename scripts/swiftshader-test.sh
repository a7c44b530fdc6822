#!/usr/bin/env bash
# The GPU tests on SwiftShader, a second software device, whose limits are small: with validation, as everywhere. Debian has it in its
# package chromium; VK_SWIFTSHADER names its manifest where it lies elsewhere. 77 says that there is none.
#   swiftshader-test.sh [ARGUMENTS of cargo test, after --]
set -euo pipefail
NAME=swiftshader-test
# shellcheck source=scripts/elsewhere.sh
. "$(dirname -- "$(readlink -f -- "$0")")/elsewhere.sh"

manifest=""
for place in "${VK_SWIFTSHADER:-}" /usr/lib/chromium/vk_swiftshader_icd.json /usr/lib64/chromium-browser/vk_swiftshader_icd.json \
  /opt/google/chrome/vk_swiftshader_icd.json; do
  if [ -n "$place" ] && [ -f "$place" ]; then
    manifest=$place
    break
  fi
done
if [ -z "$manifest" ]; then
  echo "$NAME: SKIPPED: SwiftShader is not installed (Debian: package chromium)" >&2
  exit 77
fi
export VK_DRIVER_FILES=$manifest

# A driver that does not load would leave the tests to another device, or to none.
cargo run --locked -p shadecast-server-cli -- doctor --device SwiftShader --listen 127.0.0.1:0
cargo test --locked --no-fail-fast -p shadecast-gpu
cargo test --locked --no-fail-fast -p shadecast-client --lib stages
cargo test --locked --no-fail-fast -p shadecast-e2e --test stages --test id_buffer --test light --test material --test animation -- "$@"
echo "$NAME: ok"
