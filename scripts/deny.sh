#!/usr/bin/env bash
# Licences, sources, duplicate versions and security advisories of all dependencies, by deny.toml: scripts/deny.sh. Without
# cargo-deny, or without the network for the advisories, it says so and ends with 77.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
cd -- "$ROOT"
export PATH="$PATH:${CARGO_HOME:-${HOME:-/root}/.cargo}/bin"

if ! command -v cargo-deny >/dev/null; then
  echo "deny.sh: SKIPPED: there is no cargo-deny; licences, duplicates and advisories are not checked. Run: cargo install cargo-deny --locked" >&2
  exit 77
fi
# The lock file says what is built; nothing of it is looked up.
cargo-deny --offline --locked check --hide-inclusion-graph licenses bans sources
if ! cargo-deny --locked fetch db; then
  echo "deny.sh: SKIPPED: the advisory database cannot be fetched from here; licences, duplicates and sources are in order" >&2
  exit 77
fi
cargo-deny --offline --locked check --hide-inclusion-graph advisories
