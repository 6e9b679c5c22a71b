#!/usr/bin/env bash
# Usage: tools/make_venv.sh FOLDER [EXTRAS]: a virtual environment, and in it jaxpomdp[EXTRAS] with the versions of
# constraints.txt (without EXTRAS: empty).
# PYTHON may name the interpreter; otherwise the first Python of at least 3.11 on the path is taken.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$1
extras=${2:-}

new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python}; do
        if new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    echo "jaxpomdp needs Python 3.11 or newer, and none of '${PYTHON:-python3 ... python3.11}' is one." >&2
    echo "Name one: make PYTHON=/path/to/python3.12 ..." >&2
    return 1
}

create() {
    local python=$1
    if "$python" -c 'import ensurepip' >/dev/null 2>&1; then
        "$python" -m venv --clear "$folder"
    elif "$python" -m virtualenv --version >/dev/null 2>&1; then
        "$python" -m virtualenv --quiet --clear "$folder"
    elif command -v uv >/dev/null 2>&1; then
        uv venv --quiet --seed --clear --python "$python" "$folder"
    else
        echo "$python cannot make virtual environments: its module 'ensurepip' is missing." >&2
        echo "On Debian and Ubuntu: sudo apt-get install python3-venv; or install 'virtualenv' or 'uv'." >&2
        return 1
    fi
}

if [ ! -x "$folder/bin/python" ] || ! new_enough "$folder/bin/python"; then
    python=$(find_python)
    echo "making a virtual environment in $folder with $python"
    create "$python"
fi
[ -n "$extras" ] || exit 0
echo "installing jaxpomdp[$extras] into $folder"
"$folder/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$extras]"
