"""The model in Blender's physics: broken into pieces, or whole as one rigid body."""
