"""How long a run will take on this machine, before it is started, and runs that end in a given time."""
