"""What farhand costs, measured side by side with what it cannot avoid."""
