"""The compared methods, a file each, found as plugins (docs/plugins.md)."""
