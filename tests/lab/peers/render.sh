#!/usr/bin/env bash
# picofarm beside mitransient, one scene after the other on this machine: CPU seconds to 10 % and their ratio.
#
#   tests/lab/peers/render.sh [SCENE.json ...]
#
# Without arguments: room-diffuse-1, room-diffuse and room-mirror of the reference scenes ($REFERENCE, default
# ../shared/reference/transients beside the workspace). Takes some minutes a scene.
#   PICOFARM      the release binary [default: built here]
#   LAB           the release binary of tests/lab [default: built here]
#   RESOLUTION    width and height [64]
#   TRUTH_ERROR   noise of the truth that both are measured against [3%]
#   LADDER        picofarm's rungs [2,8,32,128]
#   OUT           folder for everything that is written; truths and measurements in it are used again [new folder]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../../.." && pwd)
reference=${REFERENCE:-$root/../shared/reference/transients}
resolution=${RESOLUTION:-64}
out=${OUT:-$(mktemp -d "${TMPDIR:-/tmp}/picofarm-peers-XXXXXX")}
mkdir -p "$out"

if [ $# = 0 ]; then
  set -- "$reference"/room-diffuse-1.json "$reference"/room-diffuse.json "$reference"/room-mirror.json
fi
for scene in "$@"; do
  if [ ! -f "$scene" ]; then
    echo "skipped: there is no scene $scene (set REFERENCE, or name scenes)" >&2
    exit 0
  fi
done
if [ -z "${PICOFARM:-}" ]; then
  (cd "$root" && cargo build --release --locked >&2)
  PICOFARM=${CARGO_TARGET_DIR:-$root/target}/release/picofarm
fi
if [ -z "${LAB:-}" ]; then
  (cd "$root" && cargo build --release --locked -p picofarm-lab >&2)
  LAB=${CARGO_TARGET_DIR:-$root/target}/release/picofarm-lab
fi

for scene in "$@"; do
  name=$(basename "$scene" .json)
  # An exhaustive truth with a seed of its own; both sides see the same one.
  [ -d "$out/$name.truth" ] || "$PICOFARM" scene render "$scene" --split --resolution "$resolution" \
    --error "${TRUTH_ERROR:-3%}" --seed 987654321 --out "$out/$name.truth" >&2
  [ -f "$out/$name.mitransient.json" ] || "$here/mitransient.sh" "$scene" --resolution "$resolution" \
    --truth "$out/$name.truth" --out "$out/$name.mitransient.json"
  "$LAB" render "$scene" --resolution "$resolution" --truth "$out/$name.truth" \
    --ladder "${LADDER:-2,8,32,128}" --peer "$out/$name.mitransient.json" --plot "$out/$name.png"
  echo
done
echo "files: $out"
