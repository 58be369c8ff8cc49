"""C99 as templates for :mod:`training.export.c_tracker`, with what differs between observers in braces."""

FIELDS = """\
    double x[{nx}], P[{nx}][{nx}]; /* the estimate and its covariance, in scaled states */
    double mean_square; /* of the innovations; beyond its limit the estimate is lost */
    double trend[{ny}], trend_square; /* their running mean, and its mean square; beyond its limit P is inflated */
    unsigned long seen; /* samples of which anything was there, as far as that matters */
"""

INTERPOLATED = """
/* Between points that rise from 0; beyond the last, its value. */
static double interpolated(double at, const double *points, const double *values, size_t n)
{
    size_t i = 1;
    while (i < n && at >= points[i])
        i++;
    if (i == n)
        return values[n - 1];
    return values[i - 1] + (at - points[i - 1]) / (points[i] - points[i - 1]) * (values[i] - values[i - 1]);
}
"""

# D L L^T D, whose D has the first outputs of the network as logarithms, and L the others below ones.
COVARIANCE = """
/* How far that is off: the covariance in scaled states. The age is in samples. */
static void {map}_covariance(const {NAME}_observer *observer, unsigned long age, double P[{nx}][{nx}])
{{
    real a[{width}], b[{width}];
    double by_level[{levels}], rise[{tables}];
    {map}_read(observer{age}, a);
{layers}    for (size_t i = 0; i < {tables}; i++) {{
        for (size_t j = 0; j < {levels}; j++)
            by_level[j] = interpolated((double)age * {dt}, {map}_ages, {map}_rise[i * {levels} + j], {ages});
        rise[i] = interpolated({measurement_share}, {map}_levels, by_level, {levels});
    }}
{process}    const real *below = {last} + {nx};
    for (size_t i = 0; i < {nx}; i++) {{
        double scale = exp(({last}[i] < {largest} ? {last}[i] : {largest}) + rise[0]) / flow_x_scale[i];
        double variance = scale * scale;
        for (size_t j = 0; j < i; j++) {{
            P[i][j] = scale * *below++;
            variance += P[i][j] * P[i][j];
        }}
        P[i][i] = scale;
        if (variance > {map}_largest[i])
            for (size_t j = 0; j <= i; j++)
                P[i][j] *= sqrt({map}_largest[i] / variance);
    }}
    for (size_t i = {nx}; i-- > 0;) {{ /* its square takes its place: from the end on, nothing is needed that is gone */
        for (size_t j = i + 1; j-- > 0;) {{
            double sum = 0.0;
            for (size_t k = 0; k <= j; k++)
                sum += P[i][k] * P[j][k];
            P[i][j] = P[j][i] = sum;
        }}
    }}
}}
"""

BETWEEN_TABLES = "    rise[0] += {share} * (rise[1] - rise[0]);\n"

INVERT = "static void invert(const {NAME}_observer *observer, real *x_hat)"

COVARIANCE_OF_ONE = "static void covariance(const {NAME}_observer *observer, unsigned long age, double P[{nx}][{nx}])"

TRACKER = """
/* The bounds of the motion. */
static double within(double s, size_t i)
{{
    s = s < low[i] ? low[i] : s;
    return s > high[i] ? high[i] : s;
}}

/* Scaled states, behind which lie scaled inputs, a sample later: by a polynomial, whose monomials are each an earlier
   one times one of these, and a network. */
static void flow(const double in[{inputs}], double next[{nx}])
{{
    real a[{width}], b[{width}];
    double monomials[{terms}];
    monomials[0] = 1.0;
    for (size_t t = 1; t < {terms}; t++)
        monomials[t] = monomials[flow_earlier[t]] * in[flow_by[t]];
    for (size_t i = 0; i < {inputs}; i++)
        a[i] = (real)in[i];
{layers}    for (size_t i = 0; i < {nx}; i++) {{
        next[i] = in[i] + flow_gain[i] * {last}[i];
        for (size_t t = 0; t < {terms}; t++)
            next[i] += flow_polynomial[i][t] * monomials[t];
    }}
}}

/* Estimate and covariance a sample later: of the mean +- sqrt(nx) times each column of P's factor. */
static void predict(const {NAME}_observer *observer{u}, double x[{nx}], double P[{nx}][{nx}])
{{
    double L[{nx}][{nx}], in[{inputs}], points[{count}][{nx}];
    for (size_t i = 0; i < {nx}; i++) {{
        for (size_t j = 0; j <= i; j++) {{
            double entry = observer->P[i][j];
            for (size_t k = 0; k < j; k++)
                entry -= L[i][k] * L[j][k];
            if (i > j)
                L[i][j] = entry / L[j][j];
            else
                L[i][j] = entry > 0.0 ? sqrt(entry) : NAN; /* which spreads, and is noticed in track */
        }}
    }}
{scaled_inputs}    for (size_t p = 0; p < {count}; p++) {{
        for (size_t i = 0; i < {nx}; i++) {{
            double s = observer->x[i];
            if (i >= p / 2)
                s += (p % 2 ? -{far} : {far}) * L[i][p / 2];
            in[i] = within(s, i);
        }}
        flow(in, points[p]);
    }}
    for (size_t i = 0; i < {nx}; i++) {{
        x[i] = 0.0;
        for (size_t p = 0; p < {count}; p++)
            x[i] += points[p][i] / {count}.0;
        for (size_t p = 0; p < {count}; p++)
            points[p][i] -= x[i];
        for (size_t j = 0; j <= i; j++) {{
            double sum = 0.0;
            for (size_t p = 0; p < {count}; p++)
                sum += points[p][i] * points[p][j];
            P[i][j] = P[j][i] = sum / {count}.0;
        }}
        P[i][i] += Q[i];
    }}
{bent}}}

/* Innovations agree with nothing as yet. */
static void without_trend({NAME}_observer *observer)
{{
    observer->trend_square = 1.0;
    for (size_t k = 0; k < {ny}; k++)
        observer->trend[k] = 0.0;
}}

/* Predict, and take in a sample, one output after another. What is missing is replaced by what was predicted. Returns
   whether anything was there. */
static int track({NAME}_observer *observer, const real y[{ny}]{u}, real whole[{ny}])
{{
    double x[{nx}], P[{nx}][{nx}], trend[{ny}], across[{nx}], squared = 0.0, raised = 0.0, total = 0.0;
    size_t seen = 0;
    predict(observer{pass_u}, x, P);
    for (size_t k = 0; k < {ny}; k++) {{
        double expected = output_mean[k];
        for (size_t i = 0; i < {nx}; i++)
            expected += C[k][i] * x[i];
        if (isnan(y[k]))
            whole[k] = isfinite(expected) ? (real)expected : observer->y[k];
        else
            whole[k] = y[k];
    }}
    for (size_t k = 0; k < {ny}; k++) {{
        double apart = y[k] - output_mean[k], pivot = R[k];
        trend[k] = observer->trend[k];
        if (isnan(y[k]))
            continue;
        for (size_t i = 0; i < {nx}; i++) {{
            across[i] = 0.0;
            for (size_t j = 0; j < {nx}; j++)
                across[i] += C[k][j] * P[i][j];
            apart -= C[k][i] * x[i];
        }}
        for (size_t i = 0; i < {nx}; i++)
            pivot += C[k][i] * across[i];
        trend[k] += {trend_share} * (apart / sqrt(pivot) - trend[k]);
        raised += SQUARE(trend[k]);
        squared += apart * apart / pivot;
        seen++;
        for (size_t i = 0; i < {nx}; i++) {{
            x[i] += across[i] / pivot * apart;
            for (size_t j = 0; j <= i; j++)
                P[i][j] = P[j][i] = P[i][j] - across[i] / pivot * across[j];
        }}
    }}
    for (size_t i = 0; i < {nx}; i++) {{
        total += x[i];
        for (size_t j = 0; j <= i; j++)
            total += P[i][j];
    }}
    if (!isfinite(total)) {{
        observer->mean_square = INFINITY; /* lost */
        return 0;
    }}
    for (size_t i = 0; i < {nx}; i++) {{
        observer->x[i] = within(x[i], i);
        for (size_t j = 0; j < {nx}; j++)
            observer->P[i][j] = P[i][j];
    }}
    if (seen) {{
        double counted = (double)seen / {ny};
        observer->mean_square += {share} * counted * (squared / seen - observer->mean_square);
        raised *= {trend_gain} / seen;
        observer->trend_square += {trend_square_share} * counted * (raised - observer->trend_square);
        for (size_t k = 0; k < {ny}; k++)
            observer->trend[k] = trend[k];
        if (observer->seen < {window}ul)
            observer->seen++;
    }}
    if (seen && observer->trend_square > {trend_limit}) {{ /* innovations agree with one another */
        for (size_t i = 0; i < {nx}; i++)
            for (size_t j = 0; j < {nx}; j++)
                observer->P[i][j] *= {inflation};
        without_trend(observer);
    }}
    return seen > 0;
}}

/* Let T_inv say where to begin, soon after a reset where it is surer, and where the estimate is lost. */
static void supervise({NAME}_observer *observer, int told)
{{
    int lost = !(observer->mean_square <= {limit}); /* also where it is no number */
    double P[{nx}][{nx}], ours = 0.0, theirs = 0.0;
    real x_hat[{nx}];
    if (!lost && (!told || observer->seen >= {window}ul))
        return;
    /* what came before it was lost may have misled z: T_inv is no surer than so soon after a reset */
    covariance(observer, observer->seen, P);
    for (size_t i = 0; i < {nx}; i++) {{
        ours += observer->P[i][i];
        theirs += P[i][i];
    }}
    if (!lost && !(theirs < ours))
        return;
    invert(observer, x_hat);
    for (size_t i = 0; i < {nx}; i++) {{
        observer->x[i] = within((x_hat[i] - flow_x_offset[i]) / flow_x_scale[i], i);
        for (size_t j = 0; j < {nx}; j++)
            observer->P[i][j] = P[i][j];
    }}
    if (lost) {{
        observer->mean_square = 1.0;
        without_trend(observer);
    }}
}}
"""

BENT = """\
    double moved = 0.0; /* the square of how far: the flow is off by more where that is far */
    for (size_t i = 0; i < {nx}; i++)
        moved += SQUARE(x[i] - observer->x[i]);
    for (size_t i = 0; i < {nx}; i++)
        P[i][i] += SQUARE(bend[i] * moved);
"""

SCALED_INPUTS = """\
    for (size_t j = 0; j < {nu}; j++)
        in[{nx} + j] = u[j] / flow_u_scale[j];
"""

ESTIMATE_TRACKED = """
{head}
{{
    for (size_t i = 0; i < {nx}; i++)
        x_hat[i] = (real)(flow_x_offset[i] + flow_x_scale[i] * observer->x[i]);
}}
"""

BEGIN = """\
    observer->mean_square = INFINITY; /* lost as yet */
    observer->seen = 0;
    supervise(observer, 1);
"""

TAKE = """\
    real whole[{ny}];
    int told = track(observer, y{pass_u}, whole);
    y = whole;
"""
