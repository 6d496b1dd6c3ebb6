"""Stand-ins for the world: what really happens when the tasks' actions are carried out."""
