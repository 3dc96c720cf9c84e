"""How work is done anywhere: worker processes, stores that survive a kill, progress."""
