#!/usr/bin/env bash
# Builds the image from a program that is there already, and renders a scene in it as the image's own user.
#   check.sh PROGRAM
set -euo pipefail
cd "$(dirname "$0")"
program=${1:?the program to put into the image}

command -v buildah >/dev/null || { echo "SKIPPED deploy/container: no buildah here"; exit 0; }
[ "$(id -u)" = 0 ] || { echo "SKIPPED deploy/container: needs root here, for chroot"; exit 0; }

store=$(mktemp -d)
export BUILDAH_ISOLATION=chroot
buildah=(buildah --root "$store/root" --runroot "$store/run" --storage-driver vfs)
trap '"${buildah[@]}" rm --all >/dev/null 2>&1 || true; rm -rf "$store"' EXIT

BUILDER="${buildah[*]} bud --quiet" ./build.sh picofarm:check "$program" >/dev/null 2>"$store/said" || {
  cat "$store/said" >&2
  exit 1
}
container=$("${buildah[@]}" from --pull-never picofarm:check)
run() { "${buildah[@]}" run "$container" -- /usr/local/bin/picofarm "$@"; }
run --version
# A coordinator and a worker, end to end.
run demo --scenes 1 --resolution 16 --spots 4 --samples 2 --workers 1 --assets parametric --json >"$store/said" 2>&1 || {
  cat "$store/said" >&2
  exit 1
}
owner=$(stat -c %u "$("${buildah[@]}" mount "$container")/data/picofarm-demo")
[ "$owner" = 64420 ] || { echo "deploy/container: it ran as user $owner" >&2; exit 1; }
run dataset verify "$(sed -n 's/.*"dataset":"\([^"]*\)".*/\1/p' "$store/said" | tail -n 1)"
