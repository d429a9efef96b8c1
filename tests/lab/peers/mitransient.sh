#!/usr/bin/env bash
# Measures mitransient on one scene: tests/lab/peers/mitransient.sh SCENE.json --truth DIR --out FILE.json [...]
# Sets up what that needs under ~/.cache/picofarm-peers; options and method: measure_mitransient.py --help.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
cache=${XDG_CACHE_HOME:-$HOME/.cache}/picofarm-peers
say() { printf '== %s\n' "$*" >&2; }
mkdir -p "$cache"

python=$cache/venv/bin/python3
ready() { "$python" -c 'import importlib.metadata as m, mitsuba, zarr; assert m.version("mitransient") == "1.3.1"' 2>/dev/null; }
if ! ready; then
  say "setting up Python with mitransient 1.3.1 in $cache/venv"
  python3 -m venv "$cache/venv"
  "$cache/venv/bin/pip" install -q mitransient==1.3.1 mitsuba==3.9.1 'numpy>=2' 'zarr>=3.1'
  ready
fi

# Dr.Jit compiles with LLVM. 15 and 16 abort on machines with AVX-512 ("cannot select fminimum"); 19 works.
llvm() {
  local found
  for found in /usr/lib/*/libLLVM.so.19* /usr/lib/*/libLLVM-19.so* "$cache"/llvm/usr/lib/*/libLLVM.so.19*; do
    [ -e "$found" ] && ! ldd "$found" | grep -q 'not found' && echo "$found" && return
  done
  return 1
}
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ]; then
  if ! llvm >/dev/null; then
    say "unpacking Debian's libllvm19 into $cache/llvm"
    mkdir -p "$cache/llvm"
    (cd "$cache/llvm" && apt-get download -qq libllvm19 && dpkg-deb -x libllvm19_*.deb .) >&2 || true
  fi
  if ! llvm >/dev/null; then
    say "installing libllvm19"
    sudo=()
    [ "$(id -u)" = 0 ] || sudo=(sudo)
    "${sudo[@]}" apt-get update -qq >&2
    "${sudo[@]}" apt-get install -y -qq --no-install-recommends libllvm19 >&2
  fi
  DRJIT_LIBLLVM_PATH=$(llvm)
fi
export DRJIT_LIBLLVM_PATH

exec "$python" "$here/measure_mitransient.py" "$@"
