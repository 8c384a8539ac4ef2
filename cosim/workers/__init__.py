"""Objects in supervised processes: a worker, its supervisor, engines that run tasks."""
