"""The HTTP service: runs and sessions for many users, on the workers, stores and engines that batches use."""
