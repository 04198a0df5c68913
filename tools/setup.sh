#!/usr/bin/env bash
# Prepares .venv: the pinned packages, and GDAL's bindings built for the libgdal of this machine.
# `setup.sh dev` adds what tests, the site, Dask and `geomosaic view` need.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    { echo "setup: Python 3.11 or newer is needed; name one with: make setup PYTHON=/path/to/python3.11" >&2; exit 2; }

if ! command -v gdal-config >/dev/null; then
    root=""
    [ "$(id -u)" = 0 ] || root="sudo -n"
    if command -v apt-get >/dev/null && { [ -z "$root" ] || $root true 2>/dev/null; }; then
        echo "setup: installing libgdal-dev"
        $root apt-get update -qq
        DEBIAN_FRONTEND=noninteractive $root apt-get install -y -qq --no-install-recommends libgdal-dev g++ >/dev/null
    else
        echo "setup: GDAL's library is missing; install libgdal-dev (Debian, Ubuntu), gdal-devel (Fedora)," \
             "gdal (Homebrew), or use conda (docs/start.md)" >&2
        exit 2
    fi
fi

[ -x .venv/bin/python ] || "$python" -m venv .venv
pip() { .venv/bin/python -m pip --disable-pip-version-check -q "$@"; }

echo "setup: installing packages (a few minutes the first time)"
pip install -c constraints.txt 'setuptools>=77' wheel numpy
# Without --no-build-isolation the bindings are built without numpy support, silently.
.venv/bin/python -c 'from osgeo import gdal_array' 2>/dev/null ||
    pip install --no-build-isolation --no-cache-dir "gdal[numpy]==$(gdal-config --version)"
extras=""
[ "${1:-}" != dev ] || extras="[dev,dask,view,docs,raw,heic,video,thermal]"
pip install --no-build-isolation -c constraints.txt -e ".$extras" -e ./geomosaic_simulate
.venv/bin/python -c 'from osgeo import gdal_array; import rasterio, cv2, geomosaic, geomosaic_simulate' ||
    { echo "setup: the packages are there but don't load together; see the error above" >&2; exit 1; }
echo "setup: done, run .venv/bin/geomosaic --help"
