#!/usr/bin/env bash
# Installs a Debian package if a command is missing: need.sh COMMAND PACKAGE.
set -euo pipefail
command -v "$1" >/dev/null && exit
printf '== installing %s\n' "$2"
sudo=()
[ "$(id -u)" = 0 ] || sudo=(sudo)
"${sudo[@]}" apt-get update -qq
"${sudo[@]}" apt-get install -y -qq --no-install-recommends "$2" >/dev/null
