"""How the object that touches the gel has moved: rigid motions from normals, heights and dots."""
