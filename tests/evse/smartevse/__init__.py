"""SmartEVSE: the library against what is known of the boxes."""
