#!/bin/sh
# Our tree against Embree on the same rays: builds the benchmark, makes a Python environment with Embree
# in the user's cache folder, and prints the table. Arguments go to embree_rays.py.
set -eu
cd "$(dirname "$0")/../.."
venv="${XDG_CACHE_HOME:-$HOME/.cache}/picofarm-peers/embree"
if [ ! -x "$venv/bin/python" ] || ! "$venv/bin/python" -c 'import embreex, numpy' 2>/dev/null; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet embreex==4.4.0.post1 numpy
fi
bench=$(cargo bench -p picofarm-transient --bench rays --no-run --message-format=json 2>/dev/null |
    sed -n 's/.*"executable":"\([^"]*\/rays-[^"]*\)".*/\1/p' | tail -1)
[ -n "$bench" ] || { echo "rays.sh: the benchmark did not build; run: cargo bench --bench rays --no-run" >&2; exit 1; }
exec "$venv/bin/python" tests/peers/embree_rays.py "$bench" "$@"
