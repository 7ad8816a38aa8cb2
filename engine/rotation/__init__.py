"""An axial rotation: normals, contact and edges from a pixel's wave."""
