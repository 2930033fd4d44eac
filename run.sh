#!/usr/bin/env bash
# ./run.sh [smoke|quick|laptop|paper]   the whole study: environment, then the numbered scripts in order (default: quick)
# ./run.sh test                         the tests
set -euo pipefail
cd "$(dirname "$0")"

python=$(command -v python3.11 || command -v python3) || { echo "error: python 3.11 is not on the PATH" >&2; exit 2; }
if ! cmp -s requirements.txt .venv/installed.txt; then
    "$python" -m venv .venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
    cp requirements.txt .venv/installed.txt
fi

if [ "${1:-quick}" = test ]; then
    exec .venv/bin/python -m pytest -q "${@:2}"
fi
for script in 0*.py; do
    .venv/bin/python "$script" "${1:-quick}"
done
