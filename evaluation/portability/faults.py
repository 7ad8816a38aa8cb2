"""Run one small kernel on the only OpenCL device: a correct one, or one with a known fault.

``python faults.py [FAULT]`` prints the driver's version. Only a device that watches may be given
a fault: on any other it may do anything.
"""

import sys

import numpy as np
import pyopencl as cl

from mirrorskin.kernels import embedded

ITEMS = 16
SOUND = "x[i] = i;"
NEVER_SET = "a value never set"

# By its name: what stands in a kernel over items i, which has as many numbers x, n; how Oclgrind tells of it.
FAULTS = {
    "write past the end": ("x[i + 1] = i;", "Invalid write of size 4 at global"),
    "read past the end": ("x[i] = x[i + n];", "Invalid read of size 4 at global"),
    "write past a private array": (
        "float y[4] = {0}; y[i] = i; x[i] = y[i % 4];",
        "Invalid write of size 4 at private",
    ),
    "read past a private array": (
        "float y[4] = {0}; y[i % 4] = i; x[i] = y[i];",
        "Invalid read of size 4 at private",
    ),
    "two writers": ("x[0] = i;", "Write-write data race"),
    "a writer and a reader": ("x[i] = x[(i + 1) % n];", "Read-write data race"),
    NEVER_SET: ("float y[4]; y[i % 4] = i; x[i] = y[(i + 1) % 4];", "Uninitialized value"),
}


def build(context: cl.Context, body: str) -> cl.Kernel:
    """Return a kernel with these statements."""
    start = "kernel void fault(global float *x, const int n) { const int i = get_global_id(0);"
    kernel: cl.Kernel = cl.Program(context, f"{start} {body} }}").build(options=["-cl-std=CL1.2"]).fault
    return kernel


def main() -> None:
    """Run a kernel on the only device."""
    embedded.prepare()
    (device,) = [device for platform in cl.get_platforms() for device in platform.get_devices()]
    context = cl.Context([device])
    queue = cl.CommandQueue(context)
    numbers = np.zeros(ITEMS, np.float32)
    buffer = cl.Buffer(context, cl.mem_flags.COPY_HOST_PTR, hostbuf=numbers)
    body = FAULTS[sys.argv[1]][0] if len(sys.argv) > 1 else SOUND
    build(context, body)(queue, (ITEMS,), (8,), buffer, np.int32(ITEMS))
    queue.finish()
    print(device.driver_version)


if __name__ == "__main__":
    main()
