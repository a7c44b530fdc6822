#!/usr/bin/env bash
# Runs the fuzz targets of tests/fuzz for a bounded time: scripts/fuzz.sh [TARGET|all] [SECONDS]. Fails on the first input
# that crashes, hangs or takes too much memory, and says how to repeat it. Inputs found on the way are kept in target/fuzz.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
cd -- "$ROOT"
export PATH="$PATH:${CARGO_HOME:-${HOME:-/root}/.cargo}/bin"

wanted=${1:-all}
seconds=${2:-20}
case $seconds in '' | *[!0-9]*) echo "fuzz.sh: SECONDS is '$seconds', not a whole number" >&2; exit 2 ;; esac

mapfile -t targets < <(sed -n '/^\[\[bin\]\]$/,/^$/s/^name = "\(.*\)"$/\1/p' tests/fuzz/Cargo.toml)
if [ "$wanted" != all ]; then
  case " ${targets[*]} " in
    *" $wanted "*) targets=("$wanted") ;;
    *) echo "fuzz.sh: there is no target '$wanted'; there are: ${targets[*]}" >&2; exit 2 ;;
  esac
fi

# What libFuzzer needs of the compiler is LLVM's coverage instrumentation, which the stable compiler can be told to add;
# the sanitizers, which it cannot, are done without: what is fuzzed is safe Rust but for a few fenced lines.
# With --target the flags do not reach build scripts, which have no libFuzzer to link with.
host=$(rustc -vV | sed -n 's/^host: //p')
export CARGO_TARGET_DIR=$ROOT/target/fuzz
export CARGO_INCREMENTAL=0
export RUSTFLAGS="--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
-Cllvm-args=-sanitizer-coverage-trace-compares"
cargo build --locked -p shadecast-fuzz --features libfuzzer --profile fuzz --target "$host"

# Largest input in bytes: real files are taken as seeds up to this size.
max_bytes() {
  case $1 in
    scene_file) echo 16384 ;;
    *) echo 131072 ;;
  esac
}

# Real files, where they are there.
add_real_files() { # TARGET FOLDER
  local extension
  case $1 in
    gltf) extension='*.gl*' ;;
    fbx) extension='*.fbx' ;;
    scene_file)
      cp docs/*.toml server/scene/src/file/*.toml "$2"
      return
      ;;
    *) return ;;
  esac
  if [ ! -d "$ROOT/../shared/assets" ]; then return; fi
  find "$ROOT/../shared/assets" -maxdepth 1 -name "$extension" -size "-$(($(max_bytes "$1") / 1024 + 1))k" \
    -exec cp -t "$2" {} +
}

run() { # TARGET
  local target=$1 folder=$CARGO_TARGET_DIR/$1
  mkdir -p "$folder/corpus" "$folder/seeds" "$folder/crashes"
  if [ -d "tests/fuzz/seeds/$target" ]; then cp "tests/fuzz/seeds/$target"/* "$folder/seeds/"; fi
  add_real_files "$target" "$folder/seeds"
  local arguments=(-max_total_time="$seconds" -max_len="$(max_bytes "$target")" -rss_limit_mb=2560 -timeout=10
    -artifact_prefix="$folder/crashes/" -print_final_stats=1 -verbosity=0)
  if [ -f "tests/fuzz/$target.dict" ]; then arguments+=(-dict="tests/fuzz/$target.dict"); fi
  local program=$CARGO_TARGET_DIR/$host/fuzz/$target
  echo "fuzz.sh: $target for $seconds s"
  if ! "$program" "${arguments[@]}" "$folder/corpus" "$folder/seeds" >"$folder/log" 2>&1; then
    tail -n 60 "$folder/log" >&2
    echo "fuzz.sh: $target FAILED; the input lies in $folder/crashes; repeat with: $program FILE" >&2
    return 1
  fi
  sed -n 's/^stat::\(number_of_executed_units\|new_units_added\|slowest_unit_time_sec\|peak_rss_mb\): */fuzz.sh:   \1 /p' "$folder/log"
}

for target in "${targets[@]}"; do run "$target"; done
