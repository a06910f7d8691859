function [x_next, y, A, B, C, D] = {{ name }}(x, u)
% {{ NAME }}  One sample of an identified model.
%
%   [x_next, y] = {{ name }}(x, u) gives the output y at this sample and the state at the next one.
%   [x_next, y, A, B, C, D] = {{ name }}(x, u) gives the model linearised at x and u as well:
%   dx_next/dx, dx_next/du, dy/dx and dy/du. Start from x = zeros({{ nx }}, 1), as the model's
%   simulations do{% if rest %}, or from x_rest in {{ name }}.mat, at rest with u = u_offset{% endif %}.
%
{% for line in about %}
%{{ "   " + line if line }}
{% endfor %}
%
%   Names, units and the sampling frequency fs are in {{ name }}.mat. The function can be called in a
%   MATLAB Function block, and code can be generated from it.

persistent m
if isempty(m)
    m = {{ name }}_numbers();
end
if numel(x) ~= {{ nx }} || numel(u) ~= {{ nu }}
    error('{{ name }}:size', '{{ name }} takes x of {{ nx }} and u of {{ nu }} numbers; these have %d and %d.', ...
        numel(x), numel(u));
end
x = x(:);
v = u(:) - m.u_offset;
x_next = m.A * x + m.Bu * v;
y = m.Cy * x + m.Dyu * v + m.y_offset;
{% if static %}
z = m.Cz * x + m.Dzu * v;
{% if value %}
[h, slope] = neurons(m.Wz * z + m.bz);
w = m.Ww * h + m.bw;
{% else %}
p = ones({{ monomials }}, 1); % 1, z1, z2, .., z1 z1, z1 z2, ..
for i = 1:{{ monomials - 1 }}
    p(i + 1) = p(m.growth(i, 1)) * z(m.growth(i, 2));
end
w = m.C * p;
{% endif %}
x_next = x_next + m.Bw * w;
y = y + m.Dyw * w;
{% endif %}
if nargout > 2
{% if value %}
    J = m.Ww * (repmat(slope, 1, {{ nz }}) .* m.Wz); % dw/dz
{% elif static %}
    J = zeros({{ nw }}, {{ nz }}); % dw/dz
    for i = 1:size(m.slopes, 1)
        s = m.slopes(i, :);
        J(:, s(2)) = J(:, s(2)) + s(3) * p(s(4)) * m.C(:, s(1));
    end
{% endif %}
{% if static %}
    A = m.A + m.Bw * J * m.Cz;
    B = m.Bu + m.Bw * J * m.Dzu;
    C = m.Cy + m.Dyw * J * m.Cz;
    D = m.Dyu + m.Dyw * J * m.Dzu;
{% else %}
    A = m.A;
    B = m.Bu;
    C = m.Cy;
    D = m.Dyu;
{% endif %}
end
end
{% if value %}

function [h, slope] = neurons(v)
h = {{ value }};
slope = {{ slope }};
end
{% endif %}
