"""System interface: memory limits, atomic files, arrays on disk, devices."""
