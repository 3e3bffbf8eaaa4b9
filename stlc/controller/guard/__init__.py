"""Runtime safety filters (guards): they judge the policy's plans and replace unsafe ones."""
