"""C source of the compiled kernels of estimation."""
