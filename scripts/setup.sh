#!/usr/bin/env bash
# Install RoDiF Studio into .venv, once per change of what is to be installed.
#
#   scripts/setup.sh runtime    what `make demo` and `make up` need
#   scripts/setup.sh dev        that, and what `make test` needs
#
#   PYTHON=python3.12           another interpreter (3.11 to 3.13)
#   TORCH_BACKEND=cpu           which torch build to fetch: auto (CUDA where there is a GPU, else
#                               CPU; the default), cpu, cu128 …
#   INSTALLER=pip               plain pip in place of uv: slower, same versions
set -euo pipefail
cd "$(dirname "$0")/.."

kind=${1:-runtime}
case $kind in
  runtime) spec="." ;;
  dev) spec=".[dev]" ;;
  *) echo "setup.sh: unknown kind '$kind'; legal values are runtime, dev" >&2; exit 2 ;;
esac
python=${PYTHON:-python3}
backend=${TORCH_BACKEND:-auto}
installer=${INSTALLER:-uv}
case $installer in
  uv | pip) ;;
  *) echo "setup.sh: unknown INSTALLER '$installer'; legal values are uv, pip" >&2; exit 2 ;;
esac

if [ ! -x .venv/bin/python ]; then
  if ! "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))'; then
    echo "RoDiF Studio needs Python 3.11, 3.12 or 3.13; '$python' is $("$python" -V 2>&1)." >&2
    echo "Name another one: PYTHON=python3.11 make setup" >&2
    exit 1
  fi
  if ! "$python" -m venv .venv; then
    rm -rf .venv
    echo "Python's venv module is incomplete here. On Debian or Ubuntu:" >&2
    echo "  sudo apt-get install -y python3-venv" >&2
    exit 1
  fi
fi

wanted=$({ cat pyproject.toml constraints.txt; echo "$backend"; .venv/bin/python -V; } |
  sha256sum | cut -d' ' -f1)
stamp=.venv/.rodif-$kind
if [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ] ||
  { [ "$kind" = runtime ] && [ "$(cat .venv/.rodif-dev 2>/dev/null)" = "$wanted" ]; }; then
  exit 0
fi

echo "Installing into .venv (a few minutes the first time) …"
if [ "$installer" = pip ]; then
  .venv/bin/python -m pip install --quiet -c constraints.txt -e "$spec"
else
  .venv/bin/python -m pip install --quiet --disable-pip-version-check "uv>=0.13"
  torch=(--torch-backend="$backend")
  for folder in ${PIP_FIND_LINKS:-}; do
    # A folder of wheels with torch in it wins; uv would not look there beside a backend.
    if compgen -G "${folder#file://}/torch-*.whl" >/dev/null; then
      export UV_FIND_LINKS="${PIP_FIND_LINKS// /,}"
      torch=()
      break
    fi
  done
  # Compiled now, imports of torch take 2 s; not compiled, 6 s, every time where nothing may be
  # written at run time.
  UV_COMPILE_BYTECODE=1 VIRTUAL_ENV="$PWD/.venv" \
    .venv/bin/uv pip install --quiet "${torch[@]}" -c constraints.txt -e "$spec"
fi
echo "$wanted" >"$stamp"
