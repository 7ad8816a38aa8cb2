#!/bin/sh
# Run gpu.py on a machine without network, with the wheels of a folder ('make gpu-wheels' fills it):
#   evaluation/portability/gpu.sh WHEELS [RUN.json] [--seconds N]
# The machine has Python with NumPy, SciPy, h5py, OpenCV and pytest, and the driver of an NVIDIA GPU.
set -eu
wheels=$1
shift
root=$(cd "$(dirname "$0")/../.." && pwd)
room=$(mktemp -d)
trap 'rm -rf "$room"' EXIT
python3 -m pip install --quiet --no-index --no-deps --no-compile --target "$room/site" "$wheels"/*.whl
mkdir "$room/vendors"
driver=$(find /usr /lib /opt -name 'libnvidia-opencl.so.1' 2>/dev/null | head -n 1)
if [ -n "$driver" ]; then
    echo "$driver" >"$room/vendors/nvidia.icd"
    export OCL_ICD_VENDORS="$room/vendors"
fi
# The checkout instead of the wheel, which has neither evaluation nor benchmarks.
rm -rf "$room/site/mirrorskin"
ln -s "$root" "$room/site/mirrorskin"
export PYTHONPATH="$room/site" PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
python3 "$root/evaluation/portability/gpu.py" "$@"
