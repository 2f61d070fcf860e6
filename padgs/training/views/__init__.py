"""What training learns of the views themselves, whatever the method: their exposures and poses."""
