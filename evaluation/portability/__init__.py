"""Other OpenCL implementations, other processors, and GPUs; see README.md."""
