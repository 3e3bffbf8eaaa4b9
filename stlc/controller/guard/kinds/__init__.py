"""Guards, one per file; the room that proves adds its own (`stlc.assurance.guards`)."""
