"""The publications that effects are taken from, as ``idm-env effects --cite`` prints them."""

from __future__ import annotations

GIPPS_1981 = (
    "Gipps, P. G. (1981). A behavioural car-following model for computer simulation. Transportation Research Part B "
    "15(2), 105–111. doi:10.1016/0191-2615(81)90037-0"
)
JIANG_2001 = (
    "Jiang, R., Wu, Q., Zhu, Z. (2001). Full velocity difference model for a car-following theory. Physical Review "
    "E 64, 017101. doi:10.1103/PhysRevE.64.017101"
)
JOHANNINK_2019 = (
    "Johannink, T., Bahl, S., Nair, A., Luo, J., Kumar, A., Loskyll, M., Aparicio Ojea, J., Solowjow, E., Levine, S. "
    "(2019). Residual reinforcement learning for robot control. IEEE International Conference on Robotics and "
    "Automation, 6023–6029. doi:10.1109/ICRA.2019.8794127"
)
KESTING_2007 = (
    "Kesting, A., Treiber, M., Helbing, D. (2007). General lane-changing model MOBIL for car-following models. "
    "Transportation Research Record 1999, 86–94. doi:10.3141/1999-10"
)
KESTING_2010 = (
    "Kesting, A., Treiber, M., Helbing, D. (2010). Enhanced intelligent driver model to access the impact of driving "
    "strategies on traffic capacity. Philosophical Transactions of the Royal Society A 368, 4585–4605. "
    "doi:10.1098/rsta.2010.0084"
)
LAVAL_2008 = (
    "Laval, J. A., Leclercq, L. (2008). Microscopic modeling of the relaxation phenomenon using a macroscopic lane-"
    "changing model. Transportation Research Part B 42(6), 511–522. doi:10.1016/j.trb.2007.10.004"
)
LAVAL_2010 = (
    "Laval, J. A., Leclercq, L. (2010). A mechanism to describe the formation and propagation of stop-and-go waves "
    "in congested freeway traffic. Philosophical Transactions of the Royal Society A 368, 4519–4541. "
    "doi:10.1098/rsta.2010.0138"
)
MILANES_2014 = (
    "Milanés, V., Shladover, S. E. (2014). Modeling cooperative and autonomous adaptive cruise control dynamic "
    "responses using experimental data. Transportation Research Part C 48, 285–300. doi:10.1016/j.trc.2014.09.001"
)
NEWELL_1965 = (
    "Newell, G. F. (1965). Instability in dense highway traffic, a review. Proceedings of the Second International "
    "Symposium on the Theory of Traffic Flow, London 1963, 73–83."
)
RAJAMANI_2012 = "Rajamani, R. (2012). Vehicle Dynamics and Control. Springer. doi:10.1007/978-1-4614-1433-9"
REYMOND_2001 = (
    "Reymond, G., Kemeny, A., Droulez, J., Berthoz, A. (2001). Role of lateral acceleration in curve driving: "
    "driver model and experiments on a real vehicle and a driving simulator. Human Factors 43(3), 483–495. "
    "doi:10.1518/001872001775898188"
)
SCHAKEL_2010 = (
    "Schakel, W. J., van Arem, B., Netten, B. D. (2010). Effects of cooperative adaptive cruise control on traffic "
    "flow stability. 13th International IEEE Conference on Intelligent Transportation Systems, 759–764. "
    "doi:10.1109/ITSC.2010.5625133"
)
TREIBER_2000 = (
    "Treiber, M., Hennecke, A., Helbing, D. (2000). Congested traffic states in empirical observations and "
    "microscopic simulations. Physical Review E 62, 1805–1824. doi:10.1103/PhysRevE.62.1805"
)
TREIBER_2003 = (
    "Treiber, M., Helbing, D. (2003). Memory effects in microscopic traffic models and wide scattering in flow-"
    "density data. Physical Review E 68, 046119. doi:10.1103/PhysRevE.68.046119"
)
SCHAKEL_2012 = (
    "Schakel, W. J., Knoop, V. L., van Arem, B. (2012). Integrated lane change model with relaxation and "
    "synchronization. Transportation Research Record 2316, 47–57. doi:10.3141/2316-06"
)
TREIBER_2006 = (
    "Treiber, M., Kesting, A., Helbing, D. (2006). Delays, inaccuracies and anticipation in microscopic traffic "
    "models. Physica A 360(1), 71–88. doi:10.1016/j.physa.2005.05.001"
)
TREIBER_2013 = (
    "Treiber, M., Kesting, A. (2013). Traffic Flow Dynamics: Data, Models and Simulation. Springer. "
    "doi:10.1007/978-3-642-32460-4"
)
TREIBER_2018 = (
    "Treiber, M., Kesting, A. (2018). The Intelligent Driver Model with stochasticity: new insights into traffic "
    "flow oscillations. Transportation Research Part B 117, 613–623. doi:10.1016/j.trb.2017.08.012"
)
WIEDEMANN_1974 = (
    "Wiedemann, R. (1974). Simulation des Straßenverkehrsflusses. Schriftenreihe des Instituts für Verkehrswesen 8, "
    "Universität Karlsruhe."
)
XIAO_2017 = (
    "Xiao, L., Wang, M., van Arem, B. (2017). Realistic car-following models for microscopic simulation of adaptive "
    "and cooperative adaptive cruise control vehicles. Transportation Research Record 2623, 1–9. "
    "doi:10.3141/2623-01"
)
YEO_2009 = (
    "Yeo, H., Skabardonis, A. (2009). Understanding stop-and-go traffic in view of asymmetric traffic theory. "
    "Transportation and Traffic Theory 2009: Golden Jubilee, 99–115. Springer. doi:10.1007/978-1-4419-0820-9_6"
)
ZHANG_2005 = (
    "Zhang, H. M., Kim, T. (2005). A car-following theory for multiphase vehicular traffic flow. Transportation "
    "Research Part B 39(5), 385–399. doi:10.1016/j.trb.2004.06.005"
)
ZHOU_2005 = (
    "Zhou, J., Peng, H. (2005). Range policy of adaptive cruise control vehicles for improved flow stability and "
    "string stability. IEEE Transactions on Intelligent Transportation Systems 6(2), 229–237. "
    "doi:10.1109/TITS.2005.848359"
)
