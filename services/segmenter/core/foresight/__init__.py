"""What lies beyond the map's openings: regions expected by the prior and by what has been found."""
