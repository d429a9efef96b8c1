#!/bin/sh
# Our tree against Embree on the same rays: builds the benchmark, makes a Python environment with Embree
# in the user's cache folder, and prints the table. Arguments go to embree_rays.py.
set -eu
cd "$(dirname "$0")/../../.."
venv="${XDG_CACHE_HOME:-$HOME/.cache}/picofarm-peers/embree"
if [ ! -x "$venv/bin/python" ] || ! "$venv/bin/python" -c 'import embreex, numpy' 2>/dev/null; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet embreex==4.4.0.post1 numpy
fi
cargo build --release --locked -p picofarm-lab
exec "$venv/bin/python" tests/lab/peers/embree_rays.py "${CARGO_TARGET_DIR:-target}/release/picofarm-lab" "$@"
