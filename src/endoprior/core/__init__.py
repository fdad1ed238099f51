"""What every other package uses: data types, configuration, presets, checks of arrays, camera geometry."""
