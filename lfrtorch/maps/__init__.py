"""Static maps w = f(z): a network, a polynomial, known equations, a module of the user's."""
