"""Where compiled kernels are kept, and their compilation before the first event: for the node and the command lines."""
