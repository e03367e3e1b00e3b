"""From the colour of the gel to its shape: slopes, and the heights that have them."""
