"""`tactflow map`: the surface of an object that moves over the gel."""
