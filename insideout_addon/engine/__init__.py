"""The engine as Blender sees it: a Python of its own with torch in it, spoken to through JSON lines."""
