"""The machine: memory limits, files that appear whole or not at all, arrays on disk, devices."""
