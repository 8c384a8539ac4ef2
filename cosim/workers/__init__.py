"""Objects in supervised processes of their own: one worker, its supervisor, the engines that spread tasks."""
