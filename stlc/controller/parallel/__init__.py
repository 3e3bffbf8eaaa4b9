"""Training side by side: processes, Ray, ranks."""
