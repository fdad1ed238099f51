"""Images and videos to look at: color maps, contact sheets, rendered videos, the report. No score uses them."""
