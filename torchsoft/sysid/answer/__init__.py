"""What an identification found, in memory and as a file."""
