"""Pictures and films for people: colour maps, contact sheets, videos, the report. Nothing here feeds a score."""
