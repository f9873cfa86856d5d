"""Plans by gradient descent: free numbers, their objective, the search, and a proven limit."""
