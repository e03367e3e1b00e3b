"""HDF5 and Zarr: data sets as sources, and the export to HDF5."""
