#!/usr/bin/env bash
# A Postgres server of one's own in a folder, on a socket in it; nothing of an installed server is touched.
#   postgres.sh start DIR [fast|durable]   prints the server's URL; an existing DIR is started again
#   postgres.sh stop DIR [immediate]       `immediate` is a crash: it recovers when started again
# `fast` does not wait for the disk, so a power cut would harm it; a kill of the server does not: what is committed has
# been handed to the system. For tests that look at behaviour, not for those that measure.
set -euo pipefail

command=${1:?start or stop} dir=$(realpath -m "${2:?a folder}") mode=${3:-fast}

bin() { # bin NAME: a program of the server, which Debian keeps out of the PATH
  command -v "$1" 2>/dev/null && return
  local newest
  newest=$(ls -d /usr/lib/postgresql/*/bin/"$1" 2>/dev/null | sort -V | tail -1)
  [ -n "$newest" ] || { echo "postgres.sh: $1 not found; install Debian's package postgresql" >&2; exit 1; }
  echo "$newest"
}

# The server refuses to run as root.
as_user() {
  if [ "$(id -u)" != 0 ]; then "$@"; return; fi
  local user=postgres
  id "$user" >/dev/null 2>&1 || user=nobody
  setpriv --reuid="$user" --regid="$(id -g "$user")" --clear-groups "$@"
}

case $command in
start)
  if [ ! -e "$dir/data/PG_VERSION" ]; then
    mkdir -p "$dir"
    if [ "$(id -u)" = 0 ]; then chown "$(as_user id -u)" "$dir"; fi
    as_user "$(bin initdb)" -D "$dir/data" -U postgres -A trust --no-sync --no-instructions -E UTF8 --locale=C >"$dir/initdb.log"
    {
      echo "listen_addresses = ''"
      echo "unix_socket_directories = '$dir'"
      echo "max_connections = 300"
      echo "shared_buffers = 128MB"
      echo "log_min_messages = warning"
      if [ "$mode" = fast ]; then printf '%s\n' 'fsync = off' 'full_page_writes = off'; fi
    } >>"$dir/data/postgresql.conf"
  fi
  as_user "$(bin pg_ctl)" -D "$dir/data" -l "$dir/log" -w -t 60 start >/dev/null
  echo "postgres://postgres@localhost/postgres?host=$dir"
  ;;
stop)
  as_user "$(bin pg_ctl)" -D "$dir/data" -m "${3:-fast}" -w -t 60 stop >/dev/null
  ;;
*)
  echo "postgres.sh: $command is neither start nor stop" >&2
  exit 2
  ;;
esac
