#!/usr/bin/env bash
# Upgrades a working farm from one program to another, process by process, and checks that nothing is
# lost: every scene is committed once, no attempt fails, and the data set has the bytes of the old
# program. Both orders are tried: the coordinator first, and the workers first.
#
#   tests/upgrade.sh OLD-PROGRAM NEW-PROGRAM
#
# Needs python3. Both programs must have the same minor version for the second order, because a
# coordinator refuses workers of a later one. If the new program has another renderer, the scenes
# that are left wait for an old worker, and the script names them.
set -euo pipefail
[ $# = 2 ] || { echo "usage: tests/upgrade.sh OLD-PROGRAM NEW-PROGRAM" >&2; exit 2; }
old=$(realpath "$1") new=$(realpath "$2")
scenes=${SCENES:-48}
dir=$(mktemp -d)
declare -A pid=()
stop() { [ -z "${pid[$1]:-}" ] || { kill -TERM "${pid[$1]}" 2>/dev/null && wait "${pid[$1]}" 2>/dev/null || true; unset "pid[$1]"; }; }
end() { for name in "${!pid[@]}"; do stop "$name"; done; rm -rf "$dir"; }
trap end EXIT
cd "$dir"
export PICOFARM_CONFIG=/dev/null
unset PICOFARM_TOKEN PICOFARM_TOKEN_FILE

cat > job.toml <<TOML
name = "upgrade"
scenes = { kind = "primitive", count = $scenes, seed = 3, spots = 4 }
render = { resolution = 48, samples = 16, bins = 128, bin_width_m = 0.1 }
output = { store = "store", dataset = "rooms", profile = "sqrt-u16" }
TOML

fail() { echo "upgrade: $*" >&2; tail -n 20 ./*.log >&2; exit 1; }

coordinator() { # coordinator PROGRAM: starts it on the catalog of this folder
  "$1" coordinator --listen "127.0.0.1:$port" --catalog catalog.sqlite --allow-insecure >> coordinator.log 2>&1 &
  pid[coordinator]=$!
  for _ in $(seq 300); do
    "$old" --coordinator "$url" workers > /dev/null 2>&1 && return
    kill -0 "${pid[coordinator]}" 2>/dev/null || break
    sleep 0.2
  done
  fail "the coordinator did not start"
}

worker() { # worker NAME PROGRAM
  "$2" --coordinator "$url" worker --name "$1" --threads 1 >> "$1.log" 2>&1 &
  pid[$1]=$!
}

field() { python3 -c 'import json, sys; s = json.load(sys.stdin); print(s["state"], s["tasks"]["done"])'; }

until_done() { # until_done COUNT: waits until so many scenes are done
  local state done
  for _ in $(seq 1200); do
    read -r state done < <("$new" --coordinator "$url" job status "$job" --json 2>> client.log | field) || true
    [ "${done:-0}" -ge "$1" ] && return
    case ${state:-active} in failed|cancelled) fail "the job is $state with $done of $scenes scenes" ;; esac
    for name in "${!pid[@]}"; do kill -0 "${pid[$name]}" 2>/dev/null || fail "$name ended"; done
    sleep 0.5
  done
  "$new" --coordinator "$url" job explain "$job" >&2 || true
  fail "only ${done:-0} of $scenes scenes are done"
}

farm() { # farm NAME: a folder with a catalog and a store, two old workers and a job
  mkdir "$dir/$1"; cd "$dir/$1"; cp ../job.toml .
  port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
  url=http://127.0.0.1:$port
  coordinator "$old"
  worker one "$old"; worker two "$old"
  job=$("$old" --coordinator "$url" job submit job.toml --json | python3 -c 'import json, sys; print(json.load(sys.stdin)["job"])')
}

replace_coordinator() { stop coordinator; coordinator "$new"; }
replace_worker() { stop "$1"; worker "$1" "$new"; }

check() { # check NAME: the job's history and bytes
  until_done "$scenes"
  "$new" --coordinator "$url" job logs "$job" --last 100000 --json > history.json
  python3 - "$scenes" "$1" <<'PY' || fail "$1: the history is wrong"
import collections, json, sys
events = json.load(open("history.json"))
done = collections.Counter(e["task"] for e in events if e["kind"] in ("committed", "reused") and e.get("worker"))
bad = [t for t in range(int(sys.argv[1])) if done[t] != 1]
odd = [e for e in events if e["kind"] in ("failed", "dead", "alarm")]
kinds = collections.Counter(e["kind"] for e in events)
print(f"{sys.argv[2]}: {len(done)} scenes, each committed once; {dict(kinds)}")
for line in odd: print(line)
sys.exit(bool(bad or odd) and f"not committed once: {bad}")
PY
  for name in one two coordinator; do stop "$name"; done
  (cd store/rooms && find . -type f | LC_ALL=C sort | xargs sha256sum) > "$dir/$1.bytes"
}

part=$((scenes / 4))
farm reference
check reference

farm coordinator-first
until_done "$part"; replace_coordinator
until_done $((2 * part)); replace_worker one
until_done $((3 * part)); replace_worker two
check coordinator-first

farm workers-first
until_done "$part"; replace_worker one
until_done $((2 * part)); replace_worker two
until_done $((3 * part)); replace_coordinator
check workers-first

cd "$dir"
for name in coordinator-first workers-first; do
  diff reference.bytes "$name.bytes" > difference || { cat difference >&2; fail "$name: other bytes than the old program's"; }
done
echo "$(wc -l < reference.bytes) objects of $scenes scenes have equal bytes in both orders"
