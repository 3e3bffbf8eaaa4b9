"""Controllers: tasks, policies, methods, training, guards, deployment, evaluation."""
