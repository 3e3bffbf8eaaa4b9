"""What plans and closed loops are worth."""
