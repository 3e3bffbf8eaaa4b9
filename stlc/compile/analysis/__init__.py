"""What ranges say of a specification before it is used."""
