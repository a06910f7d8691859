{% set monomials = weights.C.shape[1] %}
function [w, J] = static_map(m, z)
% w = f(z) and J = dw/dz, by the product rule. A row of m.growth counts from 0.
p = ones({{ monomials }}, 1); % 1, z1, z2, .., z1 z1, z1 z2, ..
for i = 1:{{ monomials - 1 }}
    p(i + 1) = p(m.growth(i, 1) + 1) * z(m.growth(i, 2) + 1);
end
w = m.C * p;
if nargout > 1
    dp = zeros({{ monomials }}, {{ nz }});
    for i = 1:{{ monomials - 1 }}
        before = m.growth(i, 1) + 1;
        j = m.growth(i, 2) + 1;
        dp(i + 1, :) = dp(before, :) * z(j);
        dp(i + 1, j) = dp(i + 1, j) + p(before);
    end
    J = m.C * dp;
end
end
