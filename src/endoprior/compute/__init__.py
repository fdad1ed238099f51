"""How arithmetic runs on the CPU: vector types for Numba, Morton order, neighbor search, small networks, kernels."""
