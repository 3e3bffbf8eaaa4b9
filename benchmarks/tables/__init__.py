"""Tables, a module each: what is measured, its options, its columns and its text."""
