"""Why a formula fails: causes, and words for them."""
