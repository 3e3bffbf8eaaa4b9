"""Tables, a module each: measurement, options, columns and text."""
