#!/usr/bin/env bash
# A Slurm cluster of one's own on this machine, without systemd and without touching an installed one; as root.
#   slurm.sh start DIR NODES   prints the path of its slurm.conf (for SLURM_CONF) once all nodes are idle
#   slurm.sh lose DIR NODE     ends Slurm's processes on a node without a word; the worker there goes on
#   slurm.sh signal DIR NODE SIGNAL   to the worker on a node
#   slurm.sh stop DIR          cancels what runs and ends every process of the cluster, workers included
set -euo pipefail

command=${1:?start or stop} dir=$(realpath -m "${2:?a folder}")
conf=$dir/slurm.conf

free_port() { # free_port COUNT: the first of so many ports that nobody listens on
  local base port
  while :; do
    base=$((20000 + RANDOM % 12000))
    for ((port = base; port < base + $1; port++)); do
      if (exec 3<>"/dev/tcp/127.0.0.1/$port") 2>/dev/null; then continue 2; fi
    done
    echo "$base"
    return
  done
}

settings() { # settings NODES
  local host port node
  host=$(hostname -s) port=$(free_port $(($1 + 1)))
  cat <<CONF
ClusterName=picofarm-test
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$port
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CryptoType=crypto/munge
AuthInfo=socket=$dir/munge/socket
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool/%n
SlurmctldPidFile=$dir/pids/slurmctld
SlurmdPidFile=$dir/pids/%n
SlurmctldLogFile=$dir/slurmctld.stderr
SlurmdLogFile=$dir/%n.stderr
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/builtin
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0
SlurmdParameters=config_overrides
ReturnToService=2
SlurmdTimeout=5
KillWait=20
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
  for ((node = 1; node <= $1; node++)); do
    echo "NodeName=n$node NodeHostname=$host NodeAddr=127.0.0.1 Port=$((port + node)) CPUs=1 RealMemory=16384 State=UNKNOWN"
  done
}

until_true() { # until_true SECONDS COMMAND…
  local end=$((SECONDS + $1))
  shift
  until "$@"; do
    [ $SECONDS -lt $end ] || return 1
    sleep 0.1
  done
}

all_idle() { [ "$(sinfo -h -t idle -o %D 2>/dev/null)" = "$1" ]; }
no_jobs() { [ -z "$(squeue -h 2>/dev/null)" ]; }
gone() { ! kill -0 "$1" 2>/dev/null; }

# ours NAME TEXT: processes of this name whose environment names this cluster's folder and holds the text. Steps and
# workers are nobody's children any more when their slurmd is gone.
ours() {
  local process
  for process in /proc/[0-9]*; do
    [ "$(cat "$process/comm" 2>/dev/null)" = "$1" ] || continue
    if grep -qzF "SLURM_CONF=$conf" "$process/environ" 2>/dev/null && grep -qzF "$2" "$process/environ" 2>/dev/null; then
      echo "${process#/proc/}"
    fi
  done
}

case $command in
start)
  nodes=${3:?number of nodes}
  mkdir -p "$dir"/{state,spool,pids,munge}
  chmod 711 "$dir" "$dir/munge"
  (umask 077 && head -c 1024 /dev/urandom >"$dir/munge/key")
  /usr/sbin/munged --force --socket="$dir/munge/socket" --key-file="$dir/munge/key" --seed-file="$dir/munge/seed" \
    --pid-file="$dir/pids/munged" --log-file="$dir/munged.stderr"
  settings "$nodes" >"$conf"
  export SLURM_CONF=$conf
  slurmctld -c -f "$conf"
  for ((node = 1; node <= nodes; node++)); do
    mkdir -p "$dir/spool/n$node"
    slurmd -N "n$node" -f "$conf"
  done
  until_true 60 all_idle "$nodes" || {
    echo "slurm.sh: $nodes nodes did not become idle; the logs are in $dir" >&2
    exit 1
  }
  echo "$conf"
  ;;
lose)
  # The worker's parent is the step that looks after it.
  worker=$(ours picofarm "SLURMD_NODENAME=${3:?a node}")
  kill -9 "$(cat "$dir/pids/$3")" "$(ps -o ppid= -p "$worker" | tr -d ' ')"
  ;;
signal)
  kill -s "${4:?a signal}" "$(ours picofarm "SLURMD_NODENAME=${3:?a node}")"
  ;;
stop)
  export SLURM_CONF=$conf
  # Polite first, as far as there is still a controller to be asked.
  if squeue -h >/dev/null 2>&1; then
    scancel --user=root 2>/dev/null || true
    until_true 15 no_jobs || true
  fi
  mapfile -t daemons < <(cat "$dir"/pids/* 2>/dev/null)
  for pid in "${daemons[@]}"; do kill "$pid" 2>/dev/null || true; done
  for pid in "${daemons[@]}"; do until_true 10 gone "$pid" || kill -9 "$pid" || true; done
  for pid in $(ours slurmstepd '') $(ours picofarm ''); do kill -9 "$pid" 2>/dev/null || true; done
  ;;
*)
  echo "slurm.sh: $command is neither start nor stop" >&2
  exit 2
  ;;
esac
