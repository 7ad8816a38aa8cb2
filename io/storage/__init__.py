"""HDF5 and Zarr: their layout, chunks and checks, and files that appear complete or not at all."""
