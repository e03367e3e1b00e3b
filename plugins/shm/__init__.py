"""Pictures and arrays in shared memory: the sink `shm` and its reader."""
