"""OpenCL: the devices, and each kernel beside its NumPy reference."""
