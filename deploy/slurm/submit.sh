#!/usr/bin/env bash
# Submits workers as a job array and prints the array's id:
#   submit.sh ENVFILE SBATCH-OPTION…
#   submit.sh ~/picofarm.env --array=1-200%20 --cpus-per-task=8 --mem=8G --time=4:00:00
# ENVFILE: see ../worker.env.example. Elements run one after the other within the limit after %, so a long array
# keeps a pool alive over many wall times; `scancel ID` ends it.
set -euo pipefail

fail() { echo "submit.sh: $*" >&2; exit 2; }
[ $# -ge 1 ] || fail "usage: submit.sh ENVFILE SBATCH-OPTION…"
env=$(realpath -e -- "$1") || fail "$1: no such file; start from worker.env.example"
shift

mode=$(stat -c %a -- "$env")
[[ $mode == *00 ]] || fail "$env: mode $mode lets others read it; chmod 600 it, since it may hold keys"
grep -q '^PICOFARM_COORDINATOR=.' "$env" || fail "$env: no PICOFARM_COORDINATOR; a worker must know where to ask"
if grep -q '^PICOFARM_TOKEN=' "$env"; then
  fail "$env: PICOFARM_TOKEN; put the token into a file of its own and name it in PICOFARM_TOKEN_FILE"
fi

# Nothing else of this shell's environment travels: Slurm keeps it on the controller's disk, and secrets may be in
# it. (A list in --export= would start a login shell on the node, which can take seconds.)
for variable in $(compgen -e); do
  case $variable in
  HOME | USER | LOGNAME | PATH | LANG | SLURM_* | SBATCH_*) ;;
  *) unset "$variable" ;;
  esac
done
export PICOFARM_WORKER_ENV=$env

exec sbatch --parsable --export=ALL "$@" "$(dirname -- "$(realpath -- "$0")")/worker.sbatch"
