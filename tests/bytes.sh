#!/usr/bin/env bash
# Prints the SHA-256 of every object that a fixed set of work leaves: three renders, a data set in
# each storage profile, a training of ten steps with its predictions, and a reconstruction.
# A change that must not change results is checked by comparing two programs:
#
#   tests/bytes.sh OLD-PROGRAM > before
#   tests/bytes.sh NEW-PROGRAM > after
#   diff before after
#
# Manifests and Zarr metadata name task keys and versions, so their hashes are printed last, below
# a line "metadata". A change that renames keys changes those only. Files that hold measured times
# (`speed.json` of a model) are left out.
set -euo pipefail
[ $# = 1 ] || { echo "usage: tests/bytes.sh PROGRAM" >&2; exit 2; }
program=$(realpath "$1")
dir=$(mktemp -d)
up=
trap '[ -z "$up" ] || { kill "$up" 2>/dev/null; wait "$up" 2>/dev/null; } || true; rm -rf "$dir"' EXIT
cd "$dir"

quiet() { "$@" > log 2>&1 || { cat log >&2; exit 1; }; }

gate=(--bins 128 --bin-width-m 0.1 --samples 4)
quiet "$program" scene generate --kind furnished --assets parametric --seed 7 --spots 4 --out room.glb
quiet "$program" scene generate --kind plato --spots 4 --out plato.glb
quiet "$program" scene generate --kind desktop --seed 2 --spots 4 --out desk.glb
quiet "$program" scene render room.glb --resolution 48 "${gate[@]}" --split --out renders/room
quiet "$program" scene render plato.glb --resolution 48 "${gate[@]}" --groups per-spot --out renders/plato
quiet "$program" scene render desk.glb --resolution 48 --error 20% --beam-diameter-mm 4 --out renders/desk

stage() { # stage NAME PROFILE
  cat <<TOML
[[stage]]
name = "$1"
scenes = { kind = "primitive", count = 8, seed = 8, spots = 4 }
render = { resolution = 32, samples = 2, bins = 200, bin_width_m = 0.0768, per_spot = true }
output = { store = "store", dataset = "$1", profile = "$2" }
TOML
}
{
  echo 'name = "bytes"'
  stage rooms sqrt-u16
  stage rooms-coarse coarse
  stage rooms-plain plain-f32
  stage rooms-lossless lossless
  cat <<'TOML'
[[stage]]
kind = "split"
source = "rooms"
split = { counts = [4, 2, 2] }
[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.train]
target = "tof"
model = "tof"
net = { width = 8, levels = 3 }
optimise = { epochs = 5, batch = 2 }
[[stage]]
name = "depths"
kind = "infer"
source = "rooms"
infer = { models = ["tof"] }
output = { store = "store", dataset = "depths" }
[[stage]]
name = "rooms-3d"
kind = "reconstruct"
source = "rooms"
reconstruct = { from = "captures", grid = { nodes = 40, iterations = 10 } }
output = { store = "store", dataset = "rooms-3d" }
TOML
} > job.toml
"$program" up --listen 127.0.0.1:0 --dir farm > up.log 2>&1 &
up=$!
for _ in $(seq 100); do
  url=$(grep -oE 'https?://127\.0\.0\.1:[0-9]+' up.log | head -1) && break
  kill -0 "$up" 2>/dev/null || break
  sleep 0.1
done
[ -n "$url" ] || { cat up.log >&2; exit 1; }
quiet "$program" --coordinator "$url" job submit job.toml --watch

objects=$(find renders store -type f ! -name '.picofarm-store.json' ! -name speed.json | LC_ALL=C sort)
echo "$objects" | grep -vE '\.json$' | xargs -d '\n' sha256sum
echo metadata
echo "$objects" | grep -E '\.json$' | xargs -d '\n' sha256sum
