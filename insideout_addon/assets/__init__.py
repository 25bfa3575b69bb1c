"""Node groups and materials for Blender's asset browser."""
