#!/usr/bin/env bash
# Builds the image with buildah, podman or docker, whichever is here; nothing is pulled.
#   build.sh [TAG [PROGRAM]]      TAG: picofarm:VERSION; PROGRAM: a release build of this folder
# BUILDER="buildah --root DIR bud" says how to build.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

program=${2:-}
if [ -z "$program" ]; then
  (cd "$here" && cargo build --release --features full)
  program=${CARGO_TARGET_DIR:-$here/../../target}/release/picofarm
fi
tag=${1:-picofarm:$("$program" -V | cut -d' ' -f2)}

if [ -z "${BUILDER:-}" ]; then
  for tool in buildah podman docker; do
    command -v "$tool" >/dev/null && { BUILDER="$tool build"; break; }
  done
fi
[ -n "${BUILDER:-}" ] || { echo "build.sh: none of buildah, podman and docker is here" >&2; exit 1; }

context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
root=$context/rootfs
install -D -m 755 "$program" "$root/usr/local/bin/picofarm"
# The loader and the C library of the machine that built it, at the paths where the program looks for them.
ldd "$program" | grep -o '/[^ ]*' | while read -r library; do install -D -m 755 "$library" "$root$library"; done
install -D -m 644 /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
install -D -m 644 -t "$root/usr/share/doc/picofarm" "$here"/../../LICENSE-*
echo 'picofarm:x:64420:64420::/tmp:/' >"$root/etc/passwd"
echo 'picofarm:x:64420:' >"$root/etc/group"
install -d -m 1777 "$root/tmp" "$root/data"

cp "$here/Containerfile" "$context/"
$BUILDER --tag "$tag" --file "$context/Containerfile" "$context" >&2
echo "$tag"
