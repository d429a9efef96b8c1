#!/usr/bin/env bash
# Writes docs/reference.md from the help texts of the program: docs/reference.sh [PROGRAM]
# PROGRAM is a built picofarm [default: the debug build of this checkout]. Run it after every change of a command or option.
set -euo pipefail
cd "$(dirname "$0")"

program=$(realpath "${1:-${CARGO_TARGET_DIR:-../target}/debug/picofarm}")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
ln -s "$program" "$folder/picofarm" # help texts name the program as it was called

help() { env -i PATH="$PATH" HOME=/nonexistent "$folder/picofarm" "$@" --help; }

# What belongs to one command: neither what all commands have, nor --help and --version.
own() {
  awk '
    /^Global options:/ { exit }
    /^  -[hV], --(help|version)/ { skip = 1; next }
    skip && /^ {4,}|^$/ { next }
    /^  help  / { next }
    { skip = 0; lines[++n] = $0 }
    END {
      while (n > 0 && (lines[n] == "" || lines[n] == "Options:")) n--
      for (i = 1; i <= n; i++) if (!(lines[i] == "" && lines[i - 1] == "")) print lines[i]
    }'
}

commands() { awk '/^Commands:/ { on = 1; next } /^$/ { on = 0 } on && /^  [a-z]/ && $1 != "help" { print $1 }'; }

describe() {
  local text name level
  text=$(help "$@")
  level='##'
  [ $# -eq 1 ] || level='###'
  printf '\n%s picofarm %s\n\n```text\n%s\n```\n' "$level" "$*" "$(own <<<"$text")"
  for name in $(commands <<<"$text"); do describe "$@" "$name"; done
}

{
  printf '# Command reference\n\n'
  printf 'This page is made by `docs/reference.sh` from the help texts of picofarm. Do not edit it by hand.\n'
  printf '\n```text\n%s\n```\n' "$(help | own)"
  printf '\n## Options of every command\n\n```text\n%s\n```\n' "$(help | awk '/^Global options:/ { on = 1; next } on && /^$/ { exit } on')"
  printf '\n## Exit codes\n\n```text\n%s\n```\n' "$(help | awk '/^Exit codes:/ { on = 1; next } on')"
  for name in $(help | commands); do describe "$name"; done
} >"$folder/reference.md"
mv "$folder/reference.md" reference.md
echo "wrote docs/reference.md"
