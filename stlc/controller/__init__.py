"""Controllers: tasks, policies, training methods, guards (runtime filters), deployment, evaluation."""
