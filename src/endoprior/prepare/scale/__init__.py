"""How many mm a unit of relative depth is, from something known: a length, or the diameter of an instrument's shaft."""
