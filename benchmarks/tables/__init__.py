"""Tables of the documentation: each module measures one table and defines its options, columns and text."""
