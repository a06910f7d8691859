function m = {{ name }}_numbers()
% {{ NAME }}_NUMBERS  All numbers of {{ name }}, for MATLAB's code generation, too.

{% for name, text in literals %}
m.{{ name }} = {{ text }};
{% endfor %}
end
