"""Objects in supervised processes of their own: a worker, its supervisor, engines that run tasks."""
