"""Results as files that other programs open: meshes, points, pictures, tables, arrays."""
