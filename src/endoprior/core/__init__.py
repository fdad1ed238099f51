"""What every other package uses: data types, configuration, checks, geometry."""
