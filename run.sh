#!/usr/bin/env bash
# ./run.sh pretrained                   the published nets: environment, then evaluation and robot
# ./run.sh [smoke|quick|laptop|paper]   the whole study: environment, then the numbered scripts in order (default: quick)
# ./run.sh <preset> N                   the same with N processes a stage (06: one)
# ./run.sh test                         the tests
set -euo pipefail
cd "$(dirname "$0")"
what=${1:-quick} processes=${2:-1}
case $what in pretrained|smoke|quick|laptop|paper|test) ;; *) echo "error: $what: say pretrained, smoke, quick, laptop, paper or test" >&2; exit 2 ;; esac
[ $# -le 2 ] || { echo "error: a preset and a number only; for settings run the scripts by hand (see README.md)" >&2; exit 2; }
[ "$what" != test ] || [ $# -le 1 ] || { echo "error: test is one word" >&2; exit 2; }
[[ $processes =~ ^[1-9][0-9]*$ ]] || { echo "error: $processes: say how many processes, 1 or more" >&2; exit 2; }

if ! cmp -s requirements.txt .venv/installed.txt; then
    python=$(command -v python3.11 || command -v python3 || true)
    "${python:-false}" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        { echo "error: Python 3.11 or newer is not on the PATH" >&2; exit 2; }
    "$python" -m venv .venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
    cp requirements.txt .venv/installed.txt
fi

if [ "$what" = test ]; then
    alone=(tests/test_robot_thread.py tests/test_robot_stops.py)  # times and signals
    .venv/bin/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder "${alone[@]/#/--ignore=}"
    exec .venv/bin/python -m pytest -q "${alone[@]}"
fi
scripts=(0*.py)
[ "$what" != pretrained ] || scripts=(05*.py 06*.py)
for script in "${scripts[@]}"; do
    if [ "$processes" = 1 ] || [[ $script = 06* ]]; then
        .venv/bin/python "$script" "$what"
    else
        OMP_NUM_THREADS=1 .venv/bin/torchrun --standalone --nproc-per-node "$processes" "$script" "$what"
    fi
done
