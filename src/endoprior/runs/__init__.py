"""A training run on disk: config, log, checkpoints, identity of the data, compiled kernels."""
