"""OpenCL: the devices, and each kernel next to its NumPy reference."""
