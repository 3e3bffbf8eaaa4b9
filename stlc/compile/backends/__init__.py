"""From the intermediate representation to code that computes."""
