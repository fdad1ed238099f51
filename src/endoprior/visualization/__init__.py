"""Pictures and films for people: color maps, contact sheets, videos, the report. Nothing here feeds a score."""
