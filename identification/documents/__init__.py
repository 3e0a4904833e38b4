"""What results of identification say, as documents; and their pictures."""
