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
{% if nw %}
z = m.Cz * x + m.Dzu * v;
w = static_map(m, z);
x_next = x_next + m.Bw * w;
y = y + m.Dyw * w;
{% endif %}
if nargout > 2
{% if nw %}
    [~, J] = static_map(m, z);
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
{% if nw %}

{% include "maps/" ~ written.template ~ ".m" %}
{% endif %}
