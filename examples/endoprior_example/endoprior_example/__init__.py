"""One plugin of each kind: a layout, a method, a score and an export format."""
