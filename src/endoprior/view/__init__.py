"""Web viewer of a trained scene or a raw sequence. Only `server` and `browsers` have side effects."""
