"""Checks of user input and the errors that they raise."""
