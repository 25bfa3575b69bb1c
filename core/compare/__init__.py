"""`insideout compare`: the methods of the paper's tables on one capture or more, measured alike and side by side."""
