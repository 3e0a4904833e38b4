"""What people use instead of armcal, each tool called as its documentation says; run by test_peers.py in processes."""
