#!/usr/bin/env bash
# Checks how setup.sh reads a machine's apt sources, on fixtures: no root, no network.
set -euo pipefail
ROOT=$(dirname -- "$(dirname -- "$(readlink -f -- "$0")")")
work=$(mktemp -d)
trap 'rm -rf -- "$work"' EXIT
APT_DIR=$work/apt
OS_RELEASE=$work/os-release
# shellcheck source=scripts/setup.sh
. "$ROOT/scripts/setup.sh"

failures=0
expect() { # WHAT EXPECTED ACTUAL
  if [ "$2" != "$3" ]; then
    printf 'FAILED: %s\n--- expected\n%s\n--- got\n%s\n' "$1" "$2" "$3" >&2
    failures=$((failures + 1))
  fi
}

machine() { # ID CODENAME
  rm -rf -- "$APT_DIR"
  mkdir -p "$APT_DIR/sources.list.d"
  printf 'ID=%s\nVERSION_CODENAME=%s\n' "$1" "$2" >"$OS_RELEASE"
}

machine debian bookworm
cat >"$APT_DIR/sources.list" <<'END'
# deb http://commented.example/debian bookworm main
deb cdrom:[Debian 12]/ bookworm main
deb-src http://mirror.example/debian bookworm main
deb http://mirror.example/security bookworm-security main
deb [arch=amd64 signed-by=/usr/share/keyrings/own.gpg] http://mirror.example/debian bookworm main contrib # ours
END
expect "one-line sources give their mirror and their key" "Types: deb
URIs: http://mirror.example/debian
Suites: bookworm-backports
Components: main
Signed-By: /usr/share/keyrings/own.gpg" "$(backports_stanza bookworm)"
expect "Debian 12 takes Mesa from backports" yes "$(wants_backports && echo yes)"
expect "backports are not there yet" no "$(has_suite bookworm-backports || echo no)"
backports_stanza bookworm >"$APT_DIR/sources.list.d/$BACKPORTS_FILE"
expect "what was written is found again" yes "$(has_suite bookworm-backports && echo yes)"

machine debian bookworm
cat >"$APT_DIR/sources.list.d/debian.sources" <<'END'
Types: deb
Enabled: no
URIs: http://disabled.example/debian
Suites: bookworm
Components: main

# the archive
Types: deb deb-src
# a comment inside a stanza
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg
END
expect "deb822 sources give their mirror and their key" "Types: deb
URIs: http://mirror.example/debian
Suites: bookworm-backports
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg" "$(backports_stanza bookworm)"

machine debian bookworm
cat >"$APT_DIR/sources.list.d/debian.sources" <<'END'
Types: deb
URIs: http://mirror.example/debian
Suites: bookworm
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 mQINBFxy+/w=
 -----END PGP PUBLIC KEY BLOCK-----
END
expect "a key inside the stanza is kept line by line" "Types: deb
URIs: http://mirror.example/debian
Suites: bookworm-backports
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 mQINBFxy+/w=
 -----END PGP PUBLIC KEY BLOCK-----" "$(backports_stanza bookworm)"

machine debian bookworm
echo 'deb [trusted=yes] http://mirror.example/debian bookworm main' >"$APT_DIR/sources.list"
expect "an unsigned local mirror stays trusted" "Trusted: yes" "$(backports_stanza bookworm | tail -n 1)"

machine debian bookworm
expect "without a source there is no stanza" "" "$(backports_stanza bookworm)"

machine ubuntu noble
cat >"$APT_DIR/sources.list.d/ubuntu.sources" <<'END'
Types: deb
URIs: http://mirror.example/ubuntu/
Suites: noble noble-updates noble-backports
Components: main universe restricted multiverse
Signed-By: /usr/share/keyrings/ubuntu-archive-keyring.gpg
END
expect "Ubuntu 24.04 uses its own Mesa" no "$(wants_backports || echo no)"
expect "Ubuntu's suites are read" "noble noble-updates noble-backports" "$(apt_sources | cut -f 1 | xargs)"

if [ "$failures" -gt 0 ]; then exit 1; fi
echo "setup-test: ok"
