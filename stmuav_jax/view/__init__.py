"""Floor 6: files, tables and figures; nothing below this floor touches them."""
