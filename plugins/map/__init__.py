"""`tactflow map`: the surface of an object, from one contact in which it moves over the gel."""
