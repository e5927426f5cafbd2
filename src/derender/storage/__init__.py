"""Files: written atomically, checked when read; saved-model folders, their cards, packing and the Hub."""
