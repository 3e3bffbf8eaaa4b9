"""Who acts: tasks, policies, training, backup, deployment, worlds."""
