"""The printed markers of a gel: detection, mask, removal and tracking."""
