#!/usr/bin/env bash
# Runs the fuzz targets of tests/fuzz for a bounded time each: scripts/fuzz.sh [--sanitize] [TARGET|all] [SECONDS]. Fails on the
# first input that crashes, hangs or takes too much memory, and says how to repeat it. Inputs found on the way are kept in
# target/fuzz. `all` has the target decoder, whose library takes minutes to build, with --sanitize only.
#
# --sanitize: with gcc's address sanitizer in all C and C++ (ufbx, meshoptimizer, openh264 without its assembly) and under every
# allocation, Rust's too. Coverage of the C and C++ guides the mutations. It begins with a planted bug that must be reported.
# Exit code 77: the compiler cannot do it. Kept in target/fuzz-sanitize.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
cd -- "$ROOT"
export PATH="$PATH:${CARGO_HOME:-${HOME:-/root}/.cargo}/bin"

sanitize=
if [ "${1:-}" = --sanitize ]; then sanitize=yes; shift; fi
wanted=${1:-all}
seconds=${2:-20}
case $seconds in '' | *[!0-9]*) echo "fuzz.sh: SECONDS is '$seconds', not a whole number" >&2; exit 2 ;; esac

mapfile -t targets < <(sed -n '/^\[\[bin\]\]$/,/^$/s/^name = "\(.*\)"$/\1/p' tests/fuzz/Cargo.toml | grep -vx overread)
features=libfuzzer
if [ "$wanted" != all ]; then
  case " ${targets[*]} " in
    *" $wanted "*) targets=("$wanted") ;;
    *) echo "fuzz.sh: there is no target '$wanted'; there are: ${targets[*]}" >&2; exit 2 ;;
  esac
elif [ -z "$sanitize" ]; then
  mapfile -t targets < <(printf '%s\n' "${targets[@]}" | grep -vx decoder)
fi
if [ -n "$sanitize" ] || [ "$wanted" = decoder ]; then features+=,decoder; fi

# What libFuzzer needs of the compiler is LLVM's coverage instrumentation, which the stable compiler can be told to add;
# the sanitizers, which it cannot, are left to gcc and what it compiles: the Rust is safe but for a few fenced lines.
# With --target the flags do not reach build scripts, which have no libFuzzer to link with.
host=$(rustc -vV | sed -n 's/^host: //p')
export CARGO_TARGET_DIR=$ROOT/target/fuzz
export CARGO_INCREMENTAL=0
export RUSTFLAGS="--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
-Cllvm-args=-sanitizer-coverage-trace-compares"

# Compilers and a linker for cargo that add the sanitizer.
prepare_sanitizer() {
  local tools=$ROOT/target/fuzz-sanitize/tools flags='-fsanitize=address -fno-omit-frame-pointer -g1' compiler
  mkdir -p "$tools"
  if ! echo 'int main(void) { return 0; }' | gcc -fsanitize=address -x c -o "$tools/tried" - || ! "$tools/tried"; then
    echo "fuzz.sh: NOTHING IS SANITIZED: gcc makes no program with -fsanitize=address (above); install gcc with its libasan" >&2
    exit 77
  fi
  for compiler in gcc g++; do
    # libFuzzer itself is left as it is: it must not count its own branches.
    cat >"$tools/$compiler" <<EOF
#!/bin/sh
case "\$*" in *libfuzzer/Fuzzer*) exec $compiler "\$@" ;; esac
exec $compiler "\$@" $flags -fsanitize-coverage=trace-pc,trace-cmp
EOF
  done
  # rustc links with -nodefaultlibs, and the sanitizer's malloc must be found before libc's.
  cat >"$tools/linker" <<EOF
#!/bin/sh
exec gcc -Wl,--push-state,--no-as-needed -lasan -Wl,--pop-state -Wl,--wrap=__sanitizer_cov_trace_pc \
  "\$@" "$tools/counters.o" "$tools/overread.o"
EOF
  chmod +x "$tools/gcc" "$tools/g++" "$tools/linker"
  gcc -O2 -c -o "$tools/counters.o" tests/fuzz/sanitize/counters.c
  # shellcheck disable=SC2086 # several flags
  gcc -O2 $flags -c -o "$tools/overread.o" tests/fuzz/sanitize/overread.c
  export CARGO_TARGET_DIR=$ROOT/target/fuzz-sanitize
  export "CC_${host//-/_}=$tools/gcc" "CXX_${host//-/_}=$tools/g++"
  # The sanitizer does not see into assembly.
  export OPENH264_NO_ASM=1
  export RUSTFLAGS="$RUSTFLAGS -Clinker=$tools/linker"
  export ASAN_OPTIONS=detect_leaks=1:allocator_may_return_null=1
  features+=,overread
}
if [ -n "$sanitize" ]; then prepare_sanitizer; fi
cargo build --locked -p shadecast-fuzz --no-default-features --features "$features" --profile fuzz --target "$host"
programs=$CARGO_TARGET_DIR/$host/fuzz

# A sanitizer that reports nothing would let everything pass.
must_report_the_planted_bug() {
  local log=$CARGO_TARGET_DIR/overread.log
  if "$programs/overread" -runs=1 -artifact_prefix="$CARGO_TARGET_DIR/overread-" >"$log" 2>&1 ||
    ! grep -q 'AddressSanitizer: heap-buffer-overflow' "$log" || ! grep -q 'shadecast_overread' "$log"; then
    cat "$log" >&2
    echo "fuzz.sh: the sanitizer did not report the planted bug (above), so it would report no other" >&2
    exit 1
  fi
  echo "fuzz.sh: the sanitizer reports the planted bug"
}
if [ -n "$sanitize" ]; then must_report_the_planted_bug; fi

# Largest input in bytes: real files are taken as seeds up to this size. With the sanitizer each is read once, whatever its size.
max_bytes() {
  case $1 in
    scene_file) echo 16384 ;;
    *) echo 131072 ;;
  esac
}

# Real files, where there are any.
real_files() { # TARGET [OPTION OF FIND...]
  local assets=$ROOT/../shared/assets folders=() names=()
  case $1 in
    gltf) folders=("$assets") names=(-name '*.gl*') ;;
    fbx) folders=("$assets") names=(-name '*.fbx') ;;
    scene_file) folders=(docs server/scene/src/file) names=(-name '*.toml') ;;
    *) return 0 ;;
  esac
  [ -d "${folders[0]}" ] || return 0
  find "${folders[@]}" -maxdepth 1 "${names[@]}" "${@:2}"
}

run() { # TARGET
  local target=$1 folder=$CARGO_TARGET_DIR/$1
  mkdir -p "$folder/corpus" "$folder/seeds" "$folder/crashes"
  if [ -d "tests/fuzz/seeds/$target" ]; then cp "tests/fuzz/seeds/$target"/* "$folder/seeds/"; fi
  real_files "$target" -size "-$(($(max_bytes "$target") / 1024 + 1))k" -exec cp -t "$folder/seeds" {} +
  local arguments=(-max_total_time="$seconds" -max_len="$(max_bytes "$target")" -rss_limit_mb=2560 -timeout=10
    -artifact_prefix="$folder/crashes/" -print_final_stats=1 -verbosity=0)
  if [ -f "tests/fuzz/$target.dict" ]; then arguments+=(-dict="tests/fuzz/$target.dict"); fi
  local program=$programs/$target
  local files=()
  if [ -n "$sanitize" ]; then mapfile -t files < <(real_files "$target"); fi
  if [ ${#files[@]} -gt 0 ] && ! "$program" -rss_limit_mb=2560 -artifact_prefix="$folder/crashes/" "${files[@]}" >"$folder/log" 2>&1; then
    tail -n 60 "$folder/log" >&2
    echo "fuzz.sh: $target FAILED at one of its ${#files[@]} real files, the last that is named in $folder/log" >&2
    return 1
  fi
  echo "fuzz.sh: $target for $seconds s${files:+, after ${#files[@]} real files}"
  if ! "$program" "${arguments[@]}" "$folder/corpus" "$folder/seeds" >"$folder/log" 2>&1; then
    tail -n 60 "$folder/log" >&2
    echo "fuzz.sh: $target FAILED; the input lies in $folder/crashes; repeat with: $program FILE" >&2
    return 1
  fi
  sed -n "s/^stat::\\(number_of_executed_units\\|new_units_added\\|slowest_unit_time_sec\\|peak_rss_mb\\): */fuzz.sh: $target: \\1 /p" "$folder/log"
}

# One on each core. All run to their end, so that one report names all that failed.
result=0
for target in "${targets[@]}"; do
  if [ "$(jobs -rp | wc -l)" -ge "$(nproc)" ]; then wait -n || result=1; fi
  run "$target" &
done
while [ -n "$(jobs -p)" ]; do wait -n || result=1; done
exit $result
